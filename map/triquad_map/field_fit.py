"""The fit of a map to rays that it was not trained on: where such a ray ends, its field is zero."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Longs

from triquad_map.places import Places

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
