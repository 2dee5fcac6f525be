"""A hash index of voxels in compiled code: 3-D cells of an unbounded lattice to row numbers.

The kernels work on two arrays, ``keys`` and ``rows``, whose length is a power of two; they are
shared by everything on the CPU that is sparse in space.
"""

import numba
import numpy as np
from numpy.typing import NDArray

EMPTY = np.int64(-1)
CELL_LIMIT = 1 << 20
"""Cells lie in ``[-CELL_LIMIT, CELL_LIMIT)`` on each axis."""

Keys = NDArray[np.int64]
Rows = NDArray[np.int32]


def new_index(capacity: int) -> tuple[Keys, Rows]:
    """Empty index arrays for up to ``capacity`` cells at a load of one half."""
    size = 1 << max(4, int(2 * capacity - 1).bit_length())
    return np.full(size, EMPTY), np.zeros(size, np.int32)


@numba.njit(cache=True, nogil=True, inline="always")
def pack(x: int, y: int, z: int) -> int:
    """Key of a cell."""
    return int(((x + CELL_LIMIT) << 42) | ((y + CELL_LIMIT) << 21) | (z + CELL_LIMIT))


@numba.njit(cache=True, nogil=True)
def unpack(key: int) -> tuple[int, int, int]:
    """The cell of a key."""
    low = (1 << 21) - 1
    return (
        (key >> 42) - CELL_LIMIT,
        ((key >> 21) & low) - CELL_LIMIT,
        (key & low) - CELL_LIMIT,
    )


@numba.njit(cache=True, nogil=True, inline="always")
def find_slot(keys: Keys, key: int) -> int:
    """Slot that holds ``key``, or the empty slot where it belongs."""
    mask = len(keys) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot: int = np.int64(mixed >> np.uint64(32)) & mask
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    return slot


@numba.njit(cache=True, nogil=True)
def reindex(keys: Keys, new_keys: Keys, new_rows: Rows) -> None:
    """Fill a new, larger index with ``keys[i] -> i``."""
    for row in range(len(keys)):
        slot = find_slot(new_keys, keys[row])
        new_keys[slot] = keys[row]
        new_rows[slot] = row


@numba.njit(cache=True, nogil=True)
def first_per_cell(points: NDArray[np.floating], cell_m: float, keys: Keys) -> NDArray[np.bool_]:
    """Marks the first of the points [N, 3] in each cell; ``keys`` is an empty index."""
    chosen = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        key = pack(
            int(np.floor(points[i, 0] / cell_m)),
            int(np.floor(points[i, 1] / cell_m)),
            int(np.floor(points[i, 2] / cell_m)),
        )
        slot = find_slot(keys, key)
        if keys[slot] == EMPTY:
            keys[slot] = key
            chosen[i] = True
    return chosen


def thin(points: NDArray[np.floating], cell_m: float) -> NDArray[np.bool_]:
    """Mask [N] that keeps one of the points [N, 3] per cell of side ``cell_m``, the first."""
    keys, _ = new_index(len(points))
    return np.asarray(first_per_cell(np.ascontiguousarray(points), cell_m, keys))
