"""Which rays pass a surface that was seen, and what they show of it.

A ray contradicts a surface only where it crosses it: a disc around the middle of the ends in a
voxel, as wide as they spread, far enough from where the ray ends itself. Where too little is known
for a disc, a ray that passes the voxel counts as a weaker sign.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats, Ints

from triquad_map.compiled.evidence.observed import (
    EARLIER_MISSES,
    EARLIER_PASSES,
    ENDS,
    HIT_SCAN,
    MEAN,
    MISSES,
    NORMAL,
    PASS_SCANS,
    PASSED_SCAN,
    PASSES,
    SPREAD,
    Observed,
    Vector,
)
from triquad_map.compiled.kernel import kernel

_SPREAD_SHARE = 0.8
_LEAST_RADIUS, _GREATEST_RADIUS = 0.15, 0.5
"""The disc's radius: a share of the ends' spread, between these, in voxels."""

_GRAZING = 0.05
"""Cosine between ray and normal below which a ray must end deeper behind the surface."""

_LEAST_COSINE = 0.01
_DEPTH, _GRAZING_DEPTH = 0.2, 0.5  # voxels behind the surface

_KNOWN_ENDS = 8
"""Where so many rays ended on a plane, only rays that cross it count."""


class Passing(NamedTuple):
    """A ray, or the part of it in a region."""

    start: Vector  # voxels
    way: Vector  # unit vector
    clear: float  # voxels from the start, up to which it contradicts what it crosses
    scan: int  # number of its scan


@kernel(inline="always")
def _crosses(ray: Passing, corner: Vector, row: int, shapes: Floats) -> bool:
    """Whether a ray crosses the disc of the surface in a voxel at its least ``corner``."""
    way = ray.way
    to_x = corner[0] + shapes[row, MEAN] - ray.start[0]
    to_y = corner[1] + shapes[row, MEAN + 1] - ray.start[1]
    to_z = corner[2] + shapes[row, MEAN + 2] - ray.start[2]
    a, b, c = shapes[row, NORMAL], shapes[row, NORMAL + 1], shapes[row, NORMAL + 2]
    along = to_x * way[0] + to_y * way[1] + to_z * way[2]
    radius = _LEAST_RADIUS
    if a != 0 or b != 0 or c != 0:
        facing = way[0] * a + way[1] * b + way[2] * c
        if abs(facing) < _LEAST_COSINE:
            return False
        along = (to_x * a + to_y * b + to_z * c) / facing
        depth = _DEPTH if abs(facing) >= _GRAZING else _GRAZING_DEPTH
        if (ray.clear - along) * abs(facing) < depth:
            return False
        spread = _SPREAD_SHARE * np.sqrt(shapes[row, SPREAD])
        radius = min(max(spread, _LEAST_RADIUS), _GREATEST_RADIUS)
    if not 0 <= along <= ray.clear:
        return False
    off_x, off_y, off_z = along * way[0] - to_x, along * way[1] - to_y, along * way[2] - to_z
    return bool(off_x * off_x + off_y * off_y + off_z * off_z <= radius * radius)


@kernel(inline="always")
def _is_known_plane(row: int, shapes: Floats) -> bool:
    """Whether enough rays ended on a plane in a voxel to count only rays that cross it."""
    flat = shapes[row, NORMAL] != 0 or shapes[row, NORMAL + 1] != 0 or shapes[row, NORMAL + 2] != 0
    return bool(flat and shapes[row, ENDS] >= _KNOWN_ENDS)


@kernel()
def note_passes(ray: Passing, crossed: Ints, observed: Observed, passed: Ints) -> None:
    """Count a ray that passes through the voxels ``crossed`` [N, 4], in whose rows rays ended.

    ``passed`` collects rows that rays of this scan passed, and in which none of them ended; its
    first number is how many follow.
    """
    shapes, counts = observed.shapes, observed.counts
    for i in range(len(crossed)):
        row = crossed[i, 3]
        if row == 0:
            continue
        crossing = _crosses(ray, (crossed[i, 0], crossed[i, 1], crossed[i, 2]), row, shapes)
        if not crossing and _is_known_plane(row, shapes):
            continue
        if counts[row, HIT_SCAN] == ray.scan:
            counts[row, EARLIER_PASSES] += 1
            counts[row, EARLIER_MISSES] += crossing
            continue
        counts[row, PASSES] += 1
        counts[row, MISSES] += crossing
        if counts[row, PASSED_SCAN] != ray.scan:
            counts[row, PASSED_SCAN] = ray.scan
            counts[row, PASS_SCANS] += 1
            passed[0] += 1
            passed[passed[0]] = row
