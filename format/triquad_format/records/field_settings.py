"""The settings that define a field, and the places of its regions: they travel with every map.

A region is a cube of the world of side ``2**depth * leaf_m``. Region ``(i, j, k)`` is centred at
``(i, j, k) * region_pitch_m`` of the map frame; neighbours overlap by ``overlap_m`` and are
blended there (see :mod:`triquad_map.composition`). Inside a region,
``u = (p - centre) / leaf_m + 2**(depth - 1)`` are leaf coordinates in ``[0, 2**depth]``.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import SettingsError
from triquad_format.records.arrays import Doubles

Encoding = Literal["both", "features", "fourier"]
"""The parts of the MLP's input."""

ENCODINGS: tuple[Encoding, ...] = get_args(Encoding)

OVERLAP_LEAVES = 16
"""Leaf cells by which neighbouring regions overlap."""

BLOCK_VOXELS = 8
"""Leaves along the side of a block of evidence."""

RegionIndex = tuple[int, int, int]

_Float = TypeVar("_Float", bound=np.floating)


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise :class:`SettingsError` unless ``low <= value <= high``."""
    if not (math.isfinite(value) and low <= value <= high):
        raise SettingsError(f"{name} = {value!r} is out of range: use {low:g} to {high:g}")


def _ranged(default: float, low: float, high: float) -> Any:
    """A field with its range as metadata, named as pydantic names it: the server reads it there."""
    return dataclasses.field(default=default, metadata={"ge": low, "le": high, "strict": True})


@dataclass(frozen=True)
class FieldSettings:
    """Shape of a tri-quadtree field; the defaults are those of 3QFP (ICRA 2024, section IV).

    Raises:
        SettingsError: a value is out of its range.
    """

    leaf_m: float = _ranged(0.2, 0.01, 10.0)
    """r: side of a leaf."""

    depth: int = _ranged(10, 6, 15)
    """L_max: depth of the quadtrees, and so the side of a region: 12 in the paper."""

    feature_levels: int = _ranged(3, 1, 4)
    """H: the deepest levels carry features, so many of them."""

    feature_size: int = _ranged(8, 1, 64)
    """d: length of a feature vector."""

    feature_std: float = _ranged(0.05, 0.0, 10.0)
    """Standard deviation of new feature vectors."""

    frequencies: int = _ranged(16, 1, 256)
    """m: number of Fourier frequencies."""

    frequency_variance: float = _ranged(50.0, 0.0, 1e6)
    """sigma^2 of the Fourier frequencies, on coordinates normalised to [-1, 1]."""

    hidden: int = _ranged(32, 1, 1024)
    """Width of the MLP's two hidden layers."""

    encoding: Encoding = "both"
    """The parts of the MLP's input: interpolated features, Fourier features of the position, or
    both."""

    logit_scale_m: float = _ranged(0.0275, 1e-4, 10.0)
    """s: metres per unit of the MLP's output."""

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            if entry.metadata:
                low, high = entry.metadata["ge"], entry.metadata["le"]
                check_range(entry.name, getattr(self, entry.name), low=low, high=high)
        if self.encoding not in ENCODINGS:
            raise SettingsError(f"encoding = {self.encoding!r} is not one of {ENCODINGS}")

    @property
    def levels(self) -> range:
        """Quadtree levels that carry features, coarsest first."""
        return range(self.depth - self.feature_levels + 1, self.depth + 1)

    @property
    def region_side_m(self) -> float:
        """Side of a region's cube."""
        return self.leaf_m * (1 << self.depth)

    @property
    def region_pitch_m(self) -> float:
        """Distance between the centres of neighbouring regions: they overlap."""
        return self.leaf_m * ((1 << self.depth) - OVERLAP_LEAVES)

    @property
    def overlap_m(self) -> float:
        """Width in which two neighbouring regions overlap and are blended."""
        return self.leaf_m * OVERLAP_LEAVES

    @property
    def owned_blocks(self) -> range:
        """Blocks of evidence, along each axis, in the space that a region alone answers for.

        Neighbours meet in the middle of their overlap.
        """
        margin = OVERLAP_LEAVES // 2 // BLOCK_VOXELS
        return range(margin, (1 << self.depth) // BLOCK_VOXELS - margin)

    @property
    def input_size(self) -> int:
        """Length of the MLP's input vector."""
        features = self.feature_levels * self.feature_size if self.encoding != "fourier" else 0
        fourier = 6 * self.frequencies if self.encoding != "features" else 0
        return features + fourier

    def region_centre(self, index: RegionIndex) -> Doubles:
        """Centre [3] of a region in the map frame, metres."""
        return np.asarray(index, np.float64) * self.region_pitch_m

    def region_corner(self, index: RegionIndex) -> Doubles:
        """Least corner [3] of a region's cube in the map frame, metres."""
        return self.region_centre(index) - self.region_side_m / 2

    def leaf_coordinates(self, offset: NDArray[_Float]) -> NDArray[_Float]:
        """Leaf coordinates [N, 3] at ``offset`` [N, 3] from a region's centre, metres."""
        return np.asarray(offset / self.leaf_m + (1 << (self.depth - 1)), offset.dtype)

    def offsets(self, leaf_coordinates: NDArray[_Float]) -> NDArray[_Float]:
        """Offsets [N, 3] from a region's centre, metres, of ``leaf_coordinates`` [N, 3]."""
        offsets = (leaf_coordinates - (1 << (self.depth - 1))) * self.leaf_m
        return np.asarray(offsets, leaf_coordinates.dtype)
