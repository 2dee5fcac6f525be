"""A hash index of voxels in compiled code: 3-D cells of an unbounded lattice to row numbers.

Everything that is sparse in space is kept in rows that such an index finds.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Ints, Longs

from triquad_map.compiled.kernel import kernel

EMPTY = np.int64(-1)
MULTIPLIER = 0x9E3779B97F4A7C15 - (1 << 64)  # 2**64 / golden ratio, as a signed number
CELL_LIMIT = 1 << 20
"""Cells lie in ``[-CELL_LIMIT, CELL_LIMIT)`` on each axis."""


class Index(NamedTuple):
    """The arrays of an index, as kernels take them."""

    keys: Longs  # [slots] EMPTY where there is none; the number of slots is a power of two
    rows: Ints  # [slots]
    row_keys: Longs  # [capacity] key of each row


def empty_keys(cells: int) -> Longs:
    """Slots of a set with room for so many cells, at a load of one half."""
    return np.full(1 << max(4, int(2 * cells - 1).bit_length()), EMPTY)


def _new_index(capacity: int) -> Index:
    """Empty arrays for ``capacity`` cells."""
    keys = empty_keys(capacity)
    return Index(keys, np.zeros(len(keys), np.int32), np.zeros(capacity, np.int64))


@kernel(inline="always")
def pack(x: int, y: int, z: int) -> int:
    """Key of a cell."""
    return int(((x + CELL_LIMIT) << 42) | ((y + CELL_LIMIT) << 21) | (z + CELL_LIMIT))


@kernel()
def unpack(key: int) -> tuple[int, int, int]:
    """The cell of a key."""
    low = (1 << 21) - 1
    return ((key >> 42) - CELL_LIMIT, ((key >> 21) & low) - CELL_LIMIT, (key & low) - CELL_LIMIT)


@kernel(inline="always")
def find_slot(keys: Longs, key: int) -> int:
    """Slot that holds ``key``, or the empty slot where it belongs."""
    mask = len(keys) - 1
    slot: int = ((key * MULTIPLIER) >> 32) & mask
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    return slot


@kernel(inline="always")
def find_row(index: Index, key: int) -> int:
    """Row of ``key``, -1 where it has none."""
    slot = find_slot(index.keys, key)
    return -1 if index.keys[slot] == EMPTY else int(index.rows[slot])


@kernel(inline="always")
def make_row(index: Index, count: int, key: int) -> int:
    """Row of ``key``; a new one is row ``count``, or -1 where there is no more room."""
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
    """Slots that the look-up of any key in the index may have to read."""
    mask = len(index.keys) - 1
    longest = 0
    for slot in range(len(index.keys)):
        if index.keys[slot] != EMPTY:
            home = ((index.keys[slot] * MULTIPLIER) >> 32) & mask
            longest = max(longest, ((slot - home) & mask) + 1)
    return longest


@kernel()
def cells_of(keys: Longs) -> Longs:
    """The cells [N, 3] of ``keys`` [N]."""
    cells = np.empty((len(keys), 3), np.int64)
    for i in range(len(keys)):
        cells[i, 0], cells[i, 1], cells[i, 2] = unpack(keys[i])
    return cells


class VoxelIndex:
    """Cells in use, numbered as they come: row ``i`` of the owner's arrays belongs to cell ``i``.

    Kernels receive :attr:`arrays` and return the new number of rows; the owner stores it in
    :attr:`count`, and calls :meth:`grow` where a kernel stopped for want of room.
    """

    def __init__(self, capacity: int) -> None:
        self.count = 0
        self.arrays = _new_index(capacity)

    @property
    def capacity(self) -> int:
        """Ints that there is room for."""
        return len(self.arrays.row_keys)

    def cells(self) -> Longs:
        """The cells [count, 3], by row."""
        return np.asarray(cells_of(self.arrays.row_keys[: self.count]))

    def grow(self) -> None:
        """Double the room."""
        self._refill(self.arrays.row_keys[: self.count], 2 * self.capacity)

    def freeze(self) -> Index:
        """A copy of the arrays, with no room for more cells."""
        keys, rows, row_keys = self.arrays
        return Index(keys.copy(), rows.copy(), row_keys[: self.count].copy())

    @classmethod
    def of_cells(cls, cells: Longs) -> "VoxelIndex":
        """An index whose rows belong to different ``cells`` [N, 3], in their order."""
        x, y, z = cells.T + CELL_LIMIT
        index = cls(1)
        index._refill((x << 42) | (y << 21) | z, max(256, 2 * len(cells)))
        return index

    def _refill(self, keys: Longs, capacity: int) -> None:
        self.arrays = _new_index(capacity)
        self.arrays.row_keys[: len(keys)] = keys
        self.count = len(keys)
        _reindex(self.arrays, self.count)
