"""The rays that pass a surface that was seen, and what they show of it.

A ray contradicts a surface only where it crosses it: a disc around the middle of the ends in a
voxel, as wide as they spread, far enough from where the ray ends itself. Where too little is known
for a disc, a ray that passes the voxel counts as a weaker sign.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Ints

from triquad_map.compiled.evidence.observed import (
    Observed,
    ObservedVoxel,
    Vector,
    Voxel,
    is_flat,
    voxel_of,
)
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import inner_kernel, kernel

_SPREAD_SHARE = 0.8
_LEAST_RADIUS, _GREATEST_RADIUS = 0.15, 0.5
"""The disc's radius: a share of the ends' spread, between these, in voxels."""

_GRAZING = 0.05
"""Cosine between ray and normal below which a ray must end deeper behind the surface."""

_LEAST_COSINE = 0.01
_DEPTH, _GRAZING_DEPTH = 0.2, 0.5  # voxels behind the surface

_KNOWN_ENDS = 8
"""The number of rays that ended on a plane from which only rays that cross it count."""


class Passing(NamedTuple):
    """A ray, or the part of it in a region."""

    start: Vector  # voxels
    way: Vector  # unit vector
    clear: float  # voxels from the start, up to which it contradicts what it crosses
    scan: int  # number of its scan


@kernel(inline="always")
def _crosses(ray: Passing, corner: Voxel, voxel: ObservedVoxel) -> bool:
    """Return whether a ray crosses the disc of the surface in a voxel at its least ``corner``."""
    way, mean, normal = ray.way, voxel.mean, voxel.normal
    to_x = corner[0] + mean[0] - ray.start[0]
    to_y = corner[1] + mean[1] - ray.start[1]
    to_z = corner[2] + mean[2] - ray.start[2]
    along = to_x * way[0] + to_y * way[1] + to_z * way[2]
    radius = _LEAST_RADIUS
    if is_flat(voxel):
        facing = way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2]
        if abs(facing) < _LEAST_COSINE:
            return False
        along = (to_x * normal[0] + to_y * normal[1] + to_z * normal[2]) / facing
        depth = _DEPTH if abs(facing) >= _GRAZING else _GRAZING_DEPTH
        if (ray.clear - along) * abs(facing) < depth:
            return False
        radius = min(max(_SPREAD_SHARE * np.sqrt(voxel.spread), _LEAST_RADIUS), _GREATEST_RADIUS)
    if not 0 <= along <= ray.clear:
        return False
    off_x, off_y, off_z = along * way[0] - to_x, along * way[1] - to_y, along * way[2] - to_z
    return bool(off_x * off_x + off_y * off_y + off_z * off_z <= radius * radius)


@inner_kernel()
def note_passes(
    ray: Passing, crossed: Ints, seen: SeenVoxels, observed: Observed, passed: Ints
) -> None:
    """Count a ray that passes through the voxels of the rows ``crossed`` [N], in which rays ended.

    ``passed`` collects rows that rays of this scan passed, and in which none of them ended; its
    first number is how many follow.
    """
    for row in crossed:
        if row == 0:
            continue
        voxel = observed.voxels[row]
        crossing = _crosses(ray, voxel_of(row, seen, observed), voxel)
        if not crossing and voxel.ends >= _KNOWN_ENDS and is_flat(voxel):
            continue
        if voxel.hit_scan == ray.scan:
            voxel.earlier_passes += 1
            voxel.earlier_misses += crossing
            continue
        voxel.passes += 1
        voxel.misses += crossing
        if voxel.passed_scan != ray.scan:
            voxel.passed_scan = ray.scan
            voxel.pass_scans += 1
            passed[0] += 1
            passed[passed[0]] = row
