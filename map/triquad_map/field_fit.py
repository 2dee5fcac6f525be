"""The fit of a map to rays that it was not trained on: where such a ray ends, its field is zero.

It is measured in places of a region: cubes of some metres.
"""

from collections.abc import Sequence
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


_WORST = 5  # places that are reported
_LEAST_RAYS = 24  # of such a place
_UPPER = 0.9


@dataclass(frozen=True)
class PlaceFits:
    """The fit of a region's field to the held-out rays of each of P places."""

    centres: Doubles  # [P, 3] metres from the region's centre
    rays: Longs  # [P]
    medians_m: Doubles  # [P] of how far from zero the field is at the rays' ends
    errors_m: Doubles  # [N] how far it is, for each ray

    @classmethod
    def of(cls, places: Places, sdf: NDArray[np.floating]) -> "PlaceFits":
        """Return the fit of a field with ``sdf`` [N], metres, where the rays of ``places`` end."""
        errors_m = np.abs(sdf)
        return cls(
            places.centres,
            places.rays,
            places.medians(errors_m),
            errors_m.astype(np.float64),
        )


@dataclass(frozen=True)
class MapFit:
    """The fit of a map to its held-out rays."""

    rays: int
    places: int  # in which they end
    median_m: float  # of all these rays
    upper_m: float  # what 90 % of them keep below
    worst: Doubles  # [K, 3] map frame, metres: centres of the places with the largest medians
    worst_median_m: Doubles  # [K]


def map_fit(regions: Sequence[tuple[Doubles, PlaceFits]]) -> MapFit | None:
    """Return how well regions, by centre [3] and fit, fit together; ``None`` if there are none."""
    if not regions:
        return None
    errors_m = np.concatenate([fits.errors_m for _, fits in regions])
    centres = np.concatenate([centre + fits.centres for centre, fits in regions])
    medians_m = np.concatenate([fits.medians_m for _, fits in regions])
    rays = np.concatenate([fits.rays for _, fits in regions])
    enough = np.flatnonzero(rays >= _LEAST_RAYS)
    worst = enough[np.argsort(-medians_m[enough], kind="stable")[:_WORST]]
    return MapFit(
        rays=len(errors_m),
        places=len(rays),
        median_m=float(np.median(errors_m)),
        upper_m=float(np.quantile(errors_m, _UPPER)),
        worst=centres[worst],
        worst_median_m=medians_m[worst],
    )
