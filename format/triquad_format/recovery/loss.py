"""What a damaged map file has lost, and where."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_format.mapfile.parts.part import VERTICES, PartKey, extent, vertex_reach
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES, region_corner

STATUS_REACH_LEAVES = 2
"""How far beyond lost vertices a status may change: voxels that have an effect there are dropped
whole, and had an effect half a leaf beyond."""


@dataclass(frozen=True)
class Loss:
    """A part that is lost, and the box in which the map has lost something by it.

    Without a part ``/triquad/region`` all of the region is lost; without vertices the distances
    in a square column; without evidence the status in a cube. One part ``/triquad/training``
    stands for all of a region's training state.
    """

    key: PartKey
    minimum: NDArray[np.float64]  # [3] metres, map frame
    maximum: NDArray[np.float64]  # [3]

    def meets(self, centre: NDArray[np.float64], side_m: float) -> bool:
        """Whether the box meets a cube around ``centre`` [3], metres, map frame."""
        low, high = centre - side_m / 2, centre + side_m / 2
        return bool(((self.minimum <= high) & (self.maximum >= low)).all())


def loss_of(key: PartKey, settings: FieldSettings) -> Loss:
    """The loss of a part."""
    low, high = effect_box(key, settings)
    reach_m = STATUS_REACH_LEAVES * settings.leaf_m
    return Loss(key, low - reach_m, high + reach_m)


def effect_box(key: PartKey, settings: FieldSettings) -> NDArray[np.float64]:
    """Corners [2, 3] of the box in which a part has an effect itself, metres, map frame."""
    box = extent(settings, key)
    if key.topic == VERTICES:
        # A vertex has an effect as far as the side of its level's nodes; those at the upper border
        # of a square belong to the next.
        box.low[list(AXES[key.plane])] -= vertex_reach(settings)
    corner = region_corner(settings, key.region)
    return corner + np.stack([box.low, box.high]) * settings.leaf_m
