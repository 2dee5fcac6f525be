"""Boxes in the coordinates of a region."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from triquad_format.errors import FormatError
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex

SLACK_LEAVES = 1 / 16
"""Kept around a box: points are rounded to float32, at depth 15 by up to 1/128 of a leaf."""


@dataclass(frozen=True)
class LeafBox:
    """A box in the leaf coordinates of one region."""

    low: NDArray[np.floating]  # [3]
    high: NDArray[np.floating]  # [3]

    def meets(self, other: "LeafBox", slack: float = 0.0) -> bool:
        """Return whether the two come as near as ``slack`` leaves on every axis."""
        near = (self.low <= other.high + slack) & (self.high >= other.low - slack)
        return bool(near.all())


def whole_region(settings: FieldSettings) -> LeafBox:
    """Return a region's cube."""
    return LeafBox(np.zeros(3), np.full(3, float(1 << settings.depth)))


def leaf_box(settings: FieldSettings, index: RegionIndex, low: Doubles, high: Doubles) -> LeafBox:
    """Return the box between corners [3], metres, map frame, grown by what rounding may need."""
    centre = settings.region_centre(index)
    return LeafBox(
        settings.leaf_coordinates(low - centre) - SLACK_LEAVES,
        settings.leaf_coordinates(high - centre) + SLACK_LEAVES,
    )


def check_box(minimum: ArrayLike, maximum: ArrayLike) -> tuple[Doubles, Doubles]:
    """Return the corners [3] of a box, metres, as arrays.

    Raises:
        FormatError: they are not finite, or not in order.
    """
    low, high = np.asarray(minimum, np.float64), np.asarray(maximum, np.float64)
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise FormatError(f"a box from {low.tolist()} to {high.tolist()} holds nothing")
    return low, high
