"""The fit of a map to rays that it was not trained on: where such a ray ends, its field is zero.

It is measured in places of a region: cubes of some metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.cells import same_cells
from triquad_format.records.field_settings import FieldSettings
from triquad_format.wire.status_messages import FieldFit

_PLACE_LEAVES = 32.0  # side of a place
_WORST = 5  # places that are reported
_LEAST_RAYS = 24  # of such a place
_UPPER = 0.9


def in_cube(ends: NDArray[np.floating], settings: FieldSettings) -> Bools:
    """Return whether rays [N] end in the region's cube, at ``ends`` [N, 3], metres from its centre.

    Of one that crosses it and ends next to it, nothing is learnt where it ends.
    """
    inside: Bools = (np.abs(ends) < settings.region_side_m / 2).all(axis=1)
    return inside


@dataclass(frozen=True)
class PlaceFits:
    """The fit of a region's field to N held-out rays, which end in P places."""

    centres: Doubles  # [P, 3] metres from the region's centre
    rays: Longs  # [P] that end there, at least 1
    medians_m: Doubles  # [P] of how far from zero the field is at the rays' ends
    errors_m: Doubles  # [N] how far it is, for each ray

    @classmethod
    def of(cls, ends: Floats, settings: FieldSettings, sdf: Floats) -> "PlaceFits":
        """Return the fit of a field with ``sdf`` [N], metres, where rays end.

        ``ends`` [N, 3] are metres from the region's centre.
        """
        side_m = _PLACE_LEAVES * settings.leaf_m
        cells = np.floor(ends / side_m).astype(np.int64)
        first, place_of = same_cells(cells)
        rays = np.bincount(place_of, minlength=len(first)).astype(np.int64)
        errors_m = np.abs(sdf).astype(np.float64)
        ordered = errors_m[np.lexsort([errors_m, place_of])]
        medians_m = ordered[np.cumsum(rays) - rays + rays // 2]
        return cls((cells[first] + 0.5) * side_m, rays, medians_m, errors_m)


def map_fit(regions: Sequence[tuple[Doubles, PlaceFits]]) -> FieldFit | None:
    """Return how well regions, by centre [3] and fit, fit together; ``None`` if there are none."""
    if not regions:
        return None
    errors_m = np.concatenate([fits.errors_m for _, fits in regions])
    centres = np.concatenate([centre + fits.centres for centre, fits in regions])
    medians_m = np.concatenate([fits.medians_m for _, fits in regions])
    rays = np.concatenate([fits.rays for _, fits in regions])
    enough = np.flatnonzero(rays >= _LEAST_RAYS)
    worst = enough[np.argsort(-medians_m[enough], kind="stable")[:_WORST]]
    return FieldFit(
        rays=len(errors_m),
        median_m=float(np.median(errors_m)),
        upper_m=float(np.quantile(errors_m, _UPPER)),
        worst=centres[worst],
        worst_median_m=medians_m[worst].astype(np.float32),
    )
