"""The voxels of a region that rays have shown something of."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.status import Status

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import Index, find_row, pack

SHIFT = BLOCK_VOXELS.bit_length() - 1
LOW = BLOCK_VOXELS - 1
"""The bits of a voxel's coordinates that tell its place in its block."""


@kernel(inline="always")
def is_inside(x: int, y: int, z: int, side: int) -> bool:
    """Whether a voxel lies in a region of ``side`` voxels."""
    return min(x, y, z) >= 0 and max(x, y, z) < side


@kernel(inline="always")
def block_key(x: int, y: int, z: int) -> int:
    """Key of the block that holds a voxel."""
    return int(pack(x >> SHIFT, y >> SHIFT, z >> SHIFT))


@kernel(inline="always")
def byte_of(x: int, y: int) -> int:
    """The byte of the mask in which a voxel's bit stands."""
    return ((x & LOW) << SHIFT) | (y & LOW)


@kernel(inline="always")
def bit_of(z: int) -> int:
    """The byte in which a voxel's bit alone is set, as a ``uint8``."""
    bit: int = np.uint8(1 << (z & LOW))
    return bit


@kernel(inline="always")
def find_block(index: Index, x: int, y: int, z: int, side: int) -> int:
    """Row of the block that holds a voxel, -1 where there is none."""
    if not is_inside(x, y, z, side):
        return -1
    return find_row(index, block_key(x, y, z))


@kernel(inline="always")
def is_set(masks: Bytes, row: int, x: int, y: int, z: int) -> int:
    """Whether the bit of a voxel is set in the block ``row``: 0 or 1."""
    bit: int = (masks[row, byte_of(x, y)] >> (z & LOW)) & 1
    return bit


_SURFACE = np.uint8(Status.SURFACE)
_FREE = np.uint8(Status.FREE)
_UNKNOWN = np.uint8(Status.UNKNOWN)


class SeenVoxels(NamedTuple):
    """Bit masks in sparse blocks, as kernels take them."""

    side: int  # of the region, voxels
    blocks: Index
    surface: Bytes  # [blocks, BLOCK_BYTES] a ray ended in the voxel
    free: Bytes  # [blocks, BLOCK_BYTES] a ray passed through the voxel


@kernel()
def find_status(voxels: Doubles, reach: float, seen: SeenVoxels, status: Bytes) -> None:
    """Fill in the ``status`` [N] at ``voxels`` [N, 3]; surfaces reach ``reach`` beyond theirs."""
    side, blocks, surface, free = seen
    for i in range(len(voxels)):
        x0, x1 = int(np.floor(voxels[i, 0] - reach)), int(np.floor(voxels[i, 0] + reach))
        y0, y1 = int(np.floor(voxels[i, 1] - reach)), int(np.floor(voxels[i, 1] + reach))
        z0, z1 = int(np.floor(voxels[i, 2] - reach)), int(np.floor(voxels[i, 2] + reach))
        found = 0
        row = find_block(blocks, x0, y0, z0, side)
        block = (x0 >> SHIFT, y0 >> SHIFT, z0 >> SHIFT)
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                for z in range(z0, z1 + 1):
                    here = (x >> SHIFT, y >> SHIFT, z >> SHIFT)
                    if here != block:
                        row = find_block(blocks, x, y, z, side)
                        block = here
                    if row >= 0:
                        found |= is_set(surface, row, x, y, z)
            if found:
                break
        status[i] = _UNKNOWN
        if found:
            status[i] = _SURFACE
            continue
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        row = find_block(blocks, x, y, z, side)
        if row >= 0 and is_set(free, row, x, y, z):
            status[i] = _FREE


@kernel()
def find_ends(voxels: Longs, seen: SeenVoxels, ended: Bools) -> None:
    """Fill in whether rays ``ended`` [N] in ``voxels`` [N, 3]."""
    for i in range(len(voxels)):
        x, y, z = voxels[i, 0], voxels[i, 1], voxels[i, 2]
        row = find_block(seen.blocks, x, y, z, seen.side)
        ended[i] = row >= 0 and is_set(seen.surface, row, x, y, z) == 1
