"""The voxels of a region that rays have shown something of."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.status import Status

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_bits import SHIFT, find_block, is_set
from triquad_map.compiled.sparse.voxel_index import Index

_SURFACE = np.uint8(Status.SURFACE)
_FREE = np.uint8(Status.FREE)
_UNKNOWN = np.uint8(Status.UNKNOWN)


class SeenVoxels(NamedTuple):
    """Bit masks in sparse blocks, as kernels take them."""

    side: int  # of the region, voxels
    blocks: Index
    surface: Bytes  # [blocks, BLOCK_BYTES] a ray ended in the voxel
    free: Bytes  # [blocks, BLOCK_BYTES] a ray passed through the voxel


@kernel(inline="always")
def _is_near_surface(seen: SeenVoxels, x: float, y: float, z: float, reach: float) -> bool:
    """Whether a ray ended in a voxel that is less than ``reach`` away on each axis."""
    x0, x1 = int(np.floor(x - reach)), int(np.floor(x + reach))
    y0, y1 = int(np.floor(y - reach)), int(np.floor(y + reach))
    z0, z1 = int(np.floor(z - reach)), int(np.floor(z + reach))
    row = find_block(seen.blocks, x0, y0, z0, seen.side)
    block = (x0 >> SHIFT, y0 >> SHIFT, z0 >> SHIFT)
    found = 0
    for i in range(x0, x1 + 1):
        for j in range(y0, y1 + 1):
            for k in range(z0, z1 + 1):
                here = (i >> SHIFT, j >> SHIFT, k >> SHIFT)
                if here != block:
                    row = find_block(seen.blocks, i, j, k, seen.side)
                    block = here
                if row >= 0:
                    found |= is_set(seen.surface, row, i, j, k)
        if found:
            break
    return found != 0


@kernel()
def find_status(voxels: Doubles, reach: float, seen: SeenVoxels, status: Bytes) -> None:
    """Fill in the ``status`` [N] at ``voxels`` [N, 3]; surfaces reach ``reach`` beyond theirs."""
    for i in range(len(voxels)):
        if _is_near_surface(seen, voxels[i, 0], voxels[i, 1], voxels[i, 2], reach):
            status[i] = _SURFACE
            continue
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        row = find_block(seen.blocks, x, y, z, seen.side)
        status[i] = _FREE if row >= 0 and is_set(seen.free, row, x, y, z) else _UNKNOWN


@kernel()
def find_ends(voxels: Longs, seen: SeenVoxels, ended: Bools) -> None:
    """Fill in whether rays ``ended`` [N] in ``voxels`` [N, 3]."""
    for i in range(len(voxels)):
        x, y, z = voxels[i, 0], voxels[i, 1], voxels[i, 2]
        row = find_block(seen.blocks, x, y, z, seen.side)
        ended[i] = row >= 0 and is_set(seen.surface, row, x, y, z) == 1
