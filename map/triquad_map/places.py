"""Places of a region: cubes of some metres, each with how well it was learnt."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings

_PLACE_LEAVES = 32.0  # side of a place
_AXIS_BITS = 20


def place_keys(ends: NDArray[np.floating], settings: FieldSettings) -> Longs:
    """Return the place [N] of each ray, which ends at ``ends`` [N, 3], metres from the centre."""
    side_m = _PLACE_LEAVES * settings.leaf_m
    cells = np.floor(ends / side_m).astype(np.int64) + (1 << (_AXIS_BITS - 1))
    keys: Longs = cells[:, 0] << 2 * _AXIS_BITS | cells[:, 1] << _AXIS_BITS | cells[:, 2]
    return keys


def in_cube(ends: NDArray[np.floating], settings: FieldSettings) -> Bools:
    """Return whether rays [N] end in the region's cube, at ``ends`` [N, 3], metres from its centre.

    Of one that crosses it and ends next to it, nothing is learnt where it ends.
    """
    inside: Bools = (np.abs(ends) < settings.region_side_m / 2).all(axis=1)
    return inside


@dataclass(frozen=True)
class Places:
    """The P places in which N rays end."""

    keys: Longs  # [P] as of :func:`place_keys`, increasing
    place_of: NDArray[np.intp]  # [N] row of each ray's place
    rays: Longs  # [P] that end there, at least 1
    settings: FieldSettings

    @classmethod
    def of(cls, ends: Floats, settings: FieldSettings) -> "Places":
        """Return places of rays that end at ``ends`` [N, 3], metres from the region's centre."""
        keys, place_of, rays = np.unique(
            place_keys(ends, settings), return_inverse=True, return_counts=True
        )
        return cls(keys, place_of, rays, settings)

    @property
    def centres(self) -> Doubles:
        """Their centres [P, 3], metres from the region's centre."""
        shifts = np.array([2 * _AXIS_BITS, _AXIS_BITS, 0])
        cells = (self.keys[:, None] >> shifts & (1 << _AXIS_BITS) - 1) - (1 << (_AXIS_BITS - 1))
        centres: Doubles = (cells + 0.5) * (_PLACE_LEAVES * self.settings.leaf_m)
        return centres

    def medians(self, values: NDArray[np.floating]) -> Doubles:
        """Return the median of the rays' ``values`` [N] in each place [P]."""
        ordered = values[np.lexsort([values, self.place_of])]
        middles = np.cumsum(self.rays) - self.rays + self.rays // 2
        medians: Doubles = ordered[middles].astype(np.float64)
        return medians
