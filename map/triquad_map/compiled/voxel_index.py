"""Sparse voxels in compiled code: a hash index of cells, and bits of voxels in blocks.

Everything that is sparse in space is kept in rows that such an index finds by the cells of an
unbounded lattice. What is one bit a voxel is kept in masks of blocks, cubes of 8 x 8 x 8 voxels:
a byte holds the 8 voxels of one column along z.
"""

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Doubles, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS

from triquad_map.compiled.kernel import kernel

CoordinateT = TypeVar("CoordinateT")

EMPTY = np.int64(-1)
_MULTIPLIER = 0x9E3779B97F4A7C15 - (1 << 64)  # 2**64 / golden ratio, as a signed number
CELL_LIMIT = 1 << 20
"""Cells lie in ``[-CELL_LIMIT, CELL_LIMIT)`` on each axis."""

SHIFT = BLOCK_VOXELS.bit_length() - 1
LOW = BLOCK_VOXELS - 1
"""The bits of a voxel's coordinates that give its place in its block."""

_KEY_LOW = (1 << 21) - 1  # the bits of a key for one coordinate


class Index(NamedTuple):
    """The arrays of an index, as kernels take them."""

    keys: Longs  # [slots] EMPTY where there is none; the number of slots is a power of two
    rows: Ints  # [slots]
    row_keys: Longs  # [capacity] key of each row


def empty_keys(cells: int) -> Longs:
    """Return the slots of a set with room for ``cells`` cells, at a load of one half."""
    return np.full(1 << max(4, int(2 * cells - 1).bit_length()), EMPTY)


@kernel(inline="always")
def pack(x: int, y: int, z: int) -> int:
    """Return the key of a cell."""
    return int(((x + CELL_LIMIT) << 42) | ((y + CELL_LIMIT) << 21) | (z + CELL_LIMIT))


@kernel()
def unpack(key: int) -> tuple[int, int, int]:
    """Return the cell of a key."""
    return (
        (key >> 42) - CELL_LIMIT,
        (key >> 21 & _KEY_LOW) - CELL_LIMIT,
        (key & _KEY_LOW) - CELL_LIMIT,
    )


@register_jitable
def home_slot(key: Any, mask: int) -> Any:
    """Return where a key is searched for first: a number, or an array or tensor of int64.

    What is multiplied carries to higher bits only, and a key has the x of its cell from bit 42 on.
    """
    return (key * _MULTIPLIER >> 40) & mask


@register_jitable
def morton_code(first: CoordinateT, second: CoordinateT) -> CoordinateT:
    """Return 2-D Morton codes of non-negative int64 coordinates below 2**31: numbers or tensors.

    Those of :mod:`triquad_format.records.morton`.
    """
    codes: CoordinateT = _spread(first) | (_spread(second) << 1)
    return codes


@register_jitable
def _spread(bits: Any) -> Any:
    for shift, mask in morton.SPREAD_2D:
        bits = (bits | (bits << shift)) & mask
    return bits


@kernel(inline="always")
def find_slot(keys: Longs, key: int) -> int:
    """Return the slot of ``key``, or the empty slot where it belongs."""
    mask = len(keys) - 1
    slot: int = home_slot(key, mask)
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    return slot


@kernel(inline="always")
def find_row(index: Index, key: int) -> int:
    """Return the row of ``key``, -1 where it has none."""
    slot = find_slot(index.keys, key)
    return -1 if index.keys[slot] == EMPTY else int(index.rows[slot])


@kernel(inline="always")
def make_row(index: Index, count: int, key: int) -> int:
    """Return the row of ``key``; a new one is row ``count``, or -1 where there is no more room."""
    slot = find_slot(index.keys, key)
    if index.keys[slot] == EMPTY:
        if count == len(index.row_keys):
            return -1
        index.keys[slot] = key
        index.rows[slot] = count
        index.row_keys[count] = key
    return int(index.rows[slot])


@kernel()
def _reindex(index: Index, count: int) -> None:
    for row in range(count):
        slot = find_slot(index.keys, index.row_keys[row])
        index.keys[slot] = index.row_keys[row]
        index.rows[slot] = row


@kernel()
def longest_probe(index: Index) -> int:
    """Return how many slots the search for any key in the index may have to read."""
    mask = len(index.keys) - 1
    longest = 0
    for slot in range(len(index.keys)):
        if index.keys[slot] != EMPTY:
            home = home_slot(index.keys[slot], mask)
            longest = max(longest, ((slot - home) & mask) + 1)
    return longest


def cells_of(keys: Longs) -> Longs:
    """Return the cells [N, 3] of ``keys`` [N]."""
    return np.stack([keys >> 42, keys >> 21 & _KEY_LOW, keys & _KEY_LOW], axis=1) - CELL_LIMIT


def keys_of(cells: Longs) -> Longs:
    """Return the keys [N] of ``cells`` [N, 3]."""
    x, y, z = cells.T + CELL_LIMIT
    keys: Longs = (x << 42) | (y << 21) | z
    return keys


class VoxelIndex:
    """Cells in use, numbered as they come: row ``i`` of the owner's arrays belongs to cell ``i``.

    Kernels receive :attr:`arrays` and return the new number of rows; the owner stores it in
    :attr:`count`, and calls :meth:`grow` where a kernel stopped for want of room.
    """

    def __init__(self, capacity: int) -> None:
        self._refill(np.zeros(0, np.int64), capacity)

    @property
    def capacity(self) -> int:
        """Cells that there is room for."""
        return len(self.arrays.row_keys)

    def cells(self) -> Longs:
        """Return the cells [count, 3], by row."""
        return cells_of(self.arrays.row_keys[: self.count])

    def grow(self) -> None:
        """Double the room."""
        self._refill(self.arrays.row_keys[: self.count], 2 * self.capacity)

    def freeze(self) -> Index:
        """Return a copy of the arrays, with no room for more cells."""
        keys, rows, row_keys = self.arrays
        return Index(keys.copy(), rows.copy(), row_keys[: self.count].copy())

    @classmethod
    def of_cells(cls, cells: Longs) -> "VoxelIndex":
        """Return an index whose rows belong to different ``cells`` [N, 3], in their order."""
        index = cls(1)
        index._refill(keys_of(cells), max(256, 2 * len(cells)))
        return index

    def _refill(self, keys: Longs, capacity: int) -> None:
        slots = empty_keys(capacity)
        row_keys = with_room(keys, capacity)
        self.arrays = Index(slots, np.zeros(len(slots), np.int32), row_keys)
        self.count = len(keys)
        _reindex(self.arrays, self.count)


def with_room(rows: NDArray[Any], capacity: int) -> NDArray[Any]:
    """Return a copy of ``rows`` [N, ...] with room for ``capacity``; the new ones are zero."""
    roomy = np.zeros((capacity, *rows.shape[1:]), rows.dtype)
    roomy[: len(rows)] = rows
    return roomy


@kernel(inline="always")
def enter(keys: Longs, x: float, y: float, z: float, cell_m: float) -> bool:
    """Put the cell of a point into a set; False where it is there already."""
    key = pack(int(np.floor(x / cell_m)), int(np.floor(y / cell_m)), int(np.floor(z / cell_m)))
    slot = find_slot(keys, key)
    if keys[slot] == key:
        return False
    keys[slot] = key
    return True


@kernel()
def thin(points: Doubles, cell_m: float, keys: Longs) -> Bools:
    """Return the mask [N] of the first of points [N, 3] in each cell that is not in the set yet."""
    chosen = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        chosen[i] = enter(keys, points[i, 0], points[i, 1], points[i, 2], cell_m)
    return chosen


@kernel(inline="always")
def is_inside(x: int, y: int, z: int, side: int) -> bool:
    """Return whether a voxel lies in a region of ``side`` voxels."""
    return min(x, y, z) >= 0 and max(x, y, z) < side


@kernel(inline="always")
def block_key(x: int, y: int, z: int) -> int:
    """Return the key of the block that contains a voxel."""
    return int(pack(x >> SHIFT, y >> SHIFT, z >> SHIFT))


@kernel(inline="always")
def byte_of(x: int, y: int) -> int:
    """Return the byte of the mask in which a voxel's bit stands."""
    return ((x & LOW) << SHIFT) | (y & LOW)


@kernel(inline="always")
def bit_of(z: int) -> int:
    """Return the byte in which a voxel's bit alone is set, as a ``uint8``."""
    bit: int = np.uint8(1 << (z & LOW))
    return bit


@kernel(inline="always")
def find_block(index: Index, x: int, y: int, z: int, side: int) -> int:
    """Return the row of the block that contains a voxel, -1 where there is none."""
    if not is_inside(x, y, z, side):
        return -1
    return find_row(index, block_key(x, y, z))


@kernel(inline="always")
def is_set(masks: Bytes, row: int, x: int, y: int, z: int) -> int:
    """Return whether the bit of a voxel is set in the block ``row``: 0 or 1."""
    bit: int = (masks[row, byte_of(x, y)] >> (z & LOW)) & 1
    return bit
