"""How well a seen surface is supported, as a level that fits a file and a confidence for planners.

Each ray that ends in a voxel adds to its strength, the more the nearer the sensor was; rays from
several directions count for more than as many from one. The level is the strength on a logarithmic
scale. ``docs/queries.md`` shows how far measured errors fall as the confidence rises.
"""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bytes, Floats
from triquad_format.records.region import MAX_LEVEL

from triquad_map.surface.surfels import SurfelKind

LEVELS = MAX_LEVEL + 1

NEAR_M = 10.0
"""At this range a ray counts half as much as at the sensor."""

SECTORS_COUNTED = 5
"""Of the eight sectors of the horizon that a surface was looked at from; more add nothing."""

LEAST_STRENGTH = 0.25
"""Of level 1; each further level is twice as strong."""

HALF_LIFE_S = 86_400.0
"""While the rest of the map was seen again, confidence in what was not halves in this time."""

POINT_SHARE = 0.5
"""Of the confidence, where rays ended but the field shows no surface."""


def support_confidence(levels: Bytes, kinds: Bytes) -> Floats:
    """The confidence [N] of surfels of some :class:`SurfelKind` at these levels, just seen."""
    shares = np.where(kinds == SurfelKind.POINT, np.float32(POINT_SHARE), np.float32(1))
    return np.asarray(level_confidence()[levels] * shares, np.float32)


def level_confidence() -> Floats:
    """The confidence [LEVELS] of each level, just seen."""
    strength = LEAST_STRENGTH * 2.0 ** (np.arange(LEVELS) - 0.5)
    return np.asarray(strength / (strength + 1.0), np.float32)


def faded(age_s: NDArray[np.floating]) -> Floats:
    """The share [N] of its confidence that a surface keeps, seen last so many seconds ago."""
    return np.asarray(0.5 ** (np.maximum(age_s, 0.0) / HALF_LIFE_S), np.float32)
