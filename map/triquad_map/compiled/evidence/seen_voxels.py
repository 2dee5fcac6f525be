"""The voxels of a region that rays have shown something of, and how their ends mark them.

Kernels stop where the index has no more room; the caller makes room and goes on.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Longs

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import (
    Index,
    bit_of,
    block_key,
    byte_of,
    is_inside,
    make_row,
)


class SeenVoxels(NamedTuple):
    """Bit masks in sparse blocks, as kernels take them."""

    side: int  # of the region, voxels
    blocks: Index
    surface: Bytes  # [blocks, BLOCK_BYTES] a ray ended in the voxel
    free: Bytes  # [blocks, BLOCK_BYTES] a ray passed through the voxel


@kernel()
def mark_ends(
    voxels: Doubles, start: int, seen: SeenVoxels, count: int, new: Longs, found: int
) -> tuple[int, int, int]:
    """Set the bits of the voxels with points, and collect those that were not set before.

    Returns (points done, blocks in use, voxels collected).
    """
    masks = seen.surface
    for i in range(start, len(voxels)):
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        if not is_inside(x, y, z, seen.side):
            continue
        row = make_row(seen.blocks, count, block_key(x, y, z))
        if row < 0:
            return i, count, found
        count = max(count, row + 1)
        byte, bit = byte_of(x, y), bit_of(z)
        if not masks[row, byte] & bit:
            masks[row, byte] |= bit
            new[found, 0], new[found, 1], new[found, 2] = x, y, z
            found += 1
    return len(voxels), count, found
