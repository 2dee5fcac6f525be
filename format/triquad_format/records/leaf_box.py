"""A box in the leaf coordinates of one region."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from triquad_format.errors import FormatError
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex, leaf_coordinates, region_centre

SLACK_LEAVES = 1 / 16
"""Kept around a box: points are rounded to float32, at depth 15 by up to 1/128 of a leaf."""


@dataclass(frozen=True)
class LeafBox:
    """A box in leaf coordinates."""

    low: NDArray[np.floating]  # [3]
    high: NDArray[np.floating]  # [3]

    def meets(self, other: "LeafBox", slack: float = 0.0) -> bool:
        """Whether the two come as near as ``slack`` leaves on every axis."""
        near = (self.low <= other.high + slack) & (self.high >= other.low - slack)
        return bool(near.all())


def whole_region(settings: FieldSettings) -> LeafBox:
    """The region's cube."""
    return LeafBox(np.zeros(3), np.full(3, float(1 << settings.depth)))


def leaf_box(
    settings: FieldSettings,
    index: RegionIndex,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> LeafBox:
    """The box between two corners [3] of the map frame, grown by what rounding may need."""
    centre = region_centre(settings, index)
    return LeafBox(
        leaf_coordinates(settings, low - centre) - SLACK_LEAVES,
        leaf_coordinates(settings, high - centre) + SLACK_LEAVES,
    )


def check_box(
    minimum: ArrayLike, maximum: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The corners [3] of a box; a :class:`FormatError` where they are not finite or in order."""
    low, high = np.asarray(minimum, np.float64), np.asarray(maximum, np.float64)
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise FormatError(f"a box from {low.tolist()} to {high.tolist()} holds nothing")
    return low, high
