"""Bits of voxels: where a voxel stands in the masks of blocks of 8 x 8 x 8.

A mask is ``BLOCK_BYTES`` bytes; voxel (x, y, z) of its block is bit ``z`` of byte ``x * 8 + y``
(see :mod:`triquad_format.records.region`).
"""

import numpy as np
from triquad_format.records.arrays import Bytes
from triquad_format.records.region import BLOCK_VOXELS

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_index import Index, find_row, pack

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
