"""Rays against a table of solids.

Every solid is convex, so its signed distance is a convex function along any ray: Newton's method
started outside never steps past the first hit. The same code thus answers rays and distances.
"""

import math

import numpy as np
from numpy.typing import NDArray
from triquad_map.compiled.kernel import kernel

from triquad_tools.simulation.solids import BOUND, X, Y, Z, distance_to

_NEWTON_STEPS = 64
_HIT_M = 1e-8  # a ray this close to a surface has hit it


def cast_rays(
    solids: NDArray[np.float64],
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
    range_max_m: float,
) -> NDArray[np.float64]:
    """Ranges of the first hits of rays from one origin, which must be in free space.

    Args:
        solids: ``[S, 11]`` from :func:`triquad_tools.simulation.solids.solid_table`.
        origin: ``[3]`` metres, world frame.
        directions: ``[N, 3]`` unit vectors, world frame.
        range_max_m: rays end here.

    Returns:
        ``[N]`` metres along each ray; infinite where it hits nothing.
    """
    offsets = solids[:, [X, Y, Z]] - origin
    gaps = np.linalg.norm(offsets, axis=1) - solids[:, BOUND]
    order = np.argsort(gaps, kind="stable")  # nearest first: the first hits rule out the rest
    order = order[gaps[order] < range_max_m]
    ordered = np.ascontiguousarray(solids[order])
    return _cast(ordered, offsets[order], gaps[order], origin, directions, range_max_m)


@kernel()
def _cast(
    solids: NDArray[np.float64],
    offsets: NDArray[np.float64],
    gaps: NDArray[np.float64],
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
    range_max_m: float,
) -> NDArray[np.float64]:
    outside = np.empty(solids.shape[0])  # squared distance to the centre less squared radius
    for s in range(solids.shape[0]):
        centre = offsets[s]
        outside[s] = np.sum(centre * centre) - solids[s, BOUND] ** 2
    ranges = np.empty(directions.shape[0])
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        best = range_max_m
        for s in range(solids.shape[0]):
            if gaps[s] >= best:
                break
            start = 0.0
            if outside[s] > 0.0:
                middle = offsets[s, 0] * dx + offsets[s, 1] * dy + offsets[s, 2] * dz
                half2 = middle * middle - outside[s]
                if middle <= 0.0 or half2 < 0.0:
                    continue
                start = middle - math.sqrt(half2)
            if start < best:
                best = _hit(solids[s], origin, directions[i], start, best)
        ranges[i] = best if best < range_max_m else np.inf
    return ranges


@kernel()
def _hit(
    row: NDArray[np.float64],
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    start: float,
    limit: float,
) -> float:
    """Range from ``start`` on at which a ray hits one solid; ``limit`` if that is nearer."""
    dx, dy, dz = direction[0], direction[1], direction[2]
    t = start
    for _ in range(_NEWTON_STEPS):
        if t >= limit:
            return limit
        x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
        distance, gx, gy, gz = distance_to(row, x, y, z)
        if distance < _HIT_M:
            return t
        slope = gx * dx + gy * dy + gz * dz
        if slope >= 0.0:  # convex along the ray: from here on it only moves away
            return limit
        t -= distance / slope
    return t
