"""Which region answers for a point.

Regions stand on a fixed lattice and overlap. Each point is owned by the region whose centre is
nearest; in its core, away from the overlap with others, it is the only one that covers it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex


@dataclass(frozen=True)
class Owned:
    """Points of a query that one region answers for."""

    region: int  # its number
    points: slice | Longs  # which of the query's


@dataclass(frozen=True)
class Owners:
    """Who answers for N points."""

    groups: Sequence[Owned]  # the points that have an owner, region by region
    shared: Bools  # [N] whether other regions may cover each point, too


class Lattice(Protocol):
    """Finds the owners of points."""

    def owners(self, points: Doubles) -> Owners:
        """Who answers for points [N, 3], metres, map frame."""


class RegionLattice:
    """The regions of a map, by place; their numbers are their order."""

    def __init__(self, settings: FieldSettings, regions: Sequence[RegionIndex]) -> None:
        self._pitch_m = settings.region_pitch_m
        self._core_m = core_m(settings)
        self._regions = tuple(regions)

    def owners(self, points: Doubles) -> Owners:
        """Who answers for points [N, 3], metres, map frame."""
        places = points / self._pitch_m
        cells = np.floor(places + 0.5)
        owned = [np.flatnonzero((cells == index).all(axis=1)) for index in self._regions]
        groups = [Owned(number, rows) for number, rows in enumerate(owned) if len(rows)]
        with np.errstate(invalid="ignore"):  # of points that are nowhere
            off_m = np.abs(places - cells).max(axis=1, initial=0.0) * self._pitch_m
        return Owners(groups, off_m > self._core_m)


def core_m(settings: FieldSettings) -> float:
    """How far a region's core, which no other region covers, reaches from its centre."""
    return settings.region_side_m / 2 - settings.overlap_m
