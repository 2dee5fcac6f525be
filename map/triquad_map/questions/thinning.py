"""Fewer points that cover the same space."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles

_CELLS = 1 << 20  # along an axis
_MARGIN = 1.1
"""More than are wanted, by so much, are as good: to thin once more changes nothing."""


def thinned(points: Doubles, most: int) -> Doubles:
    """Some ``most`` of points [N, 3], evenly in space: the first of each cell of a grid.

    Points that are not finite are left out. What was thinned before stays as it is.

    Raises:
        ValueError: ``points`` are not of this shape.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have the shape {points.shape}: give [N, 3]")
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) <= _MARGIN * most:
        return points
    offsets = points - np.median(points, axis=0)
    # From cells of which the surfaces in sight fill more, to those of which they do not.
    side_m = max(float(np.median(np.abs(offsets))), 1e-3) / 256
    while True:
        cells = np.clip(np.floor(offsets / side_m) + _CELLS / 2, 0, _CELLS - 1).astype(np.int64)
        keys = (cells[:, 0] * _CELLS + cells[:, 1]) * _CELLS + cells[:, 2]
        first = np.sort(np.unique(keys, return_index=True)[1])
        points, offsets = points[first], offsets[first]
        if len(points) <= _MARGIN * most:
            return points
        side_m *= max(1.1, math.sqrt(len(points) / most))
