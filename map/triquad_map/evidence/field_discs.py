"""Discs of the field in place of rays' ends, in evidence that was restored: files have none."""

import numpy as np
from triquad_format.records.arrays import Bytes, Floats, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.evidence.ended_rays import COUNTED_ENDS
from triquad_map.evidence.observed import (
    FILLED,
    Observed,
    ObservedVoxel,
    is_flat,
    row_of,
    rows_around,
    voxel_of,
)
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.surface import SurfelKind

_DISC = int(SurfelKind.DISC)


@kernel()
def set_discs(
    voxels: Longs,
    offsets: Floats,
    normals: Floats,
    kinds: Bytes,
    seen: SeenVoxels,
    observed: Observed,
) -> None:
    """Take the discs of surfels as the ends in ``voxels`` [N, 3] of which no ray has shown any."""
    for i in range(len(voxels)):
        row = row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])
        voxel = observed.voxels[row]
        if row == 0 or voxel.ends != 0:  # rays have shown since
            continue
        is_disc = kinds[i] == _DISC
        for axis in range(3):
            voxel.mean[axis] = offsets[i, axis] + 0.5 if is_disc else np.nan
            voxel.normal[axis] = normals[i, axis] if is_disc else 0.0
        _set_spread(voxel, FILLED)
        voxel.ends = COUNTED_ENDS if is_disc else 0
    for i in range(len(voxels)):
        row = row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])
        if row != 0 and observed.voxels[row].ends == 0:
            _set_disc_beside(row, seen, observed)


@inner_kernel()
def _set_spread(voxel: ObservedVoxel, variance: float) -> None:
    """Let the ends of a voxel lie in the plane of its normal, with a variance on each axis."""
    x, y, z = voxel.normal
    voxel.spread[0], voxel.spread[1], voxel.spread[2] = 1 - x * x, -x * y, -x * z
    voxel.spread[3], voxel.spread[4], voxel.spread[5] = 1 - y * y, -y * z, 1 - z * z
    voxel.spread *= np.float32(variance)


@inner_kernel()
def _set_disc_beside(row: int, seen: SeenVoxels, observed: Observed) -> None:
    """Take the disc of a voxel next to it for one that has none: the nearest to its middle.

    The ends of noisy rays lie in voxels on both sides of a surface, and the disc in one of them.
    """
    voxel, corner = observed.voxels[row], voxel_of(row, seen, observed)
    nearest = np.inf
    for near in rows_around(row, 1, seen, observed):
        disc = observed.voxels[near]
        normal, mean = disc.normal, disc.mean
        if near == row or not is_flat(disc):
            continue
        beside = voxel_of(np.int64(near), seen, observed)
        height = 0.0
        for axis in range(3):
            height += (corner[axis] + 0.5 - beside[axis] - mean[axis]) * normal[axis]
        is_there = abs(height) < nearest
        for axis in range(3):
            foot = corner[axis] + 0.5 - height * normal[axis] - beside[axis]
            is_there = is_there and 0 <= foot <= 1
        if is_there:
            nearest = abs(height)
            for axis in range(3):
                voxel.mean[axis] = 0.5 - height * normal[axis]
                voxel.normal[axis] = normal[axis]
            voxel.ends = COUNTED_ENDS
