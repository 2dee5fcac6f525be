"""The settings that define a field: they travel with every map."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

from triquad_format.errors import SettingsError

Encoding = Literal["both", "features", "fourier"]
"""The parts of the MLP's input."""

ENCODINGS: tuple[Encoding, ...] = get_args(Encoding)

OVERLAP_LEAVES = 16
"""Leaf cells by which neighbouring regions overlap."""


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise :class:`SettingsError` unless ``low <= value <= high``."""
    if not (math.isfinite(value) and low <= value <= high):
        raise SettingsError(f"{name} = {value!r} is out of range: use {low:g} to {high:g}")


def _ranged(default: float, low: float, high: float) -> Any:
    """A field with its range as metadata, named as pydantic names it: the server reads it there."""
    return dataclasses.field(default=default, metadata={"ge": low, "le": high})


@dataclass(frozen=True)
class FieldSettings:
    """Shape of a tri-quadtree field; the defaults are those of 3QFP (ICRA 2024, section IV)."""

    leaf_m: float = _ranged(0.2, 0.01, 10.0)
    """r: side of a leaf."""

    depth: int = _ranged(12, 6, 15)
    """L_max: depth of the quadtrees."""

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
                check_range(entry.name, getattr(self, entry.name), low, high)
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
    def input_size(self) -> int:
        """Length of the MLP's input vector."""
        features = self.feature_levels * self.feature_size if self.encoding != "fourier" else 0
        fourier = 6 * self.frequencies if self.encoding != "features" else 0
        return features + fourier
