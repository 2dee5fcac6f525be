"""The settings that define a field: they travel with every map."""

import math
from dataclasses import dataclass

from triquad_format.errors import SettingsError

ENCODINGS = ("both", "features", "fourier")

OVERLAP_LEAVES = 16
"""Leaf cells by which neighbouring regions overlap."""


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise :class:`SettingsError` unless ``low <= value <= high``."""
    if not (math.isfinite(value) and low <= value <= high):
        raise SettingsError(f"{name} = {value!r} is out of range: use {low:g} to {high:g}")


@dataclass(frozen=True)
class FieldSettings:
    """Shape of a tri-quadtree field; the defaults are those of 3QFP (ICRA 2024, section IV)."""

    leaf_m: float = 0.2  # r: side of a leaf
    depth: int = 12  # L_max
    feature_levels: int = 3  # H: deepest levels that carry features
    feature_size: int = 8  # d
    feature_std: float = 0.05  # of new feature vectors
    frequencies: int = 16  # m
    frequency_variance: float = 50.0  # sigma^2, on coordinates normalised to [-1, 1]
    hidden: int = 32  # width of the MLP's two hidden layers
    encoding: str = "both"  # or "features" or "fourier": the parts of the MLP's input
    logit_scale_m: float = 0.0275  # s: metres per unit of the MLP's output

    def __post_init__(self) -> None:
        check_range("leaf_m", self.leaf_m, 0.01, 10.0)
        check_range("depth", self.depth, 6, 15)
        check_range("feature_levels", self.feature_levels, 1, 4)
        check_range("feature_size", self.feature_size, 1, 64)
        check_range("feature_std", self.feature_std, 0.0, 10.0)
        check_range("frequencies", self.frequencies, 1, 256)
        check_range("frequency_variance", self.frequency_variance, 0.0, 1e6)
        check_range("hidden", self.hidden, 1, 1024)
        check_range("logit_scale_m", self.logit_scale_m, 1e-4, 10.0)
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
