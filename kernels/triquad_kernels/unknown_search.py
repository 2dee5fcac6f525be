"""The nearest unknown voxel: no ray ended in it, and none passed through it."""

import numba
import numpy as np
from numpy.typing import NDArray
from triquad_format.region import BLOCK_BYTES, BLOCK_VOXELS

from triquad_kernels.voxel_index import CELL_LIMIT, Index, find_row, pack

_SHIFT = BLOCK_VOXELS.bit_length() - 1
_SIDE = float(BLOCK_VOXELS)
_ALL = 0xFF

Masks = NDArray[np.uint8]
Doubles = NDArray[np.float64]


@numba.njit(cache=True, nogil=True, inline="always")
def _square_gap(x: float, low: float, side: float) -> float:
    """Square of how far ``x`` lies outside of ``[low, low + side]``."""
    gap = max(low - x, x - low - side, 0.0)
    return gap * gap


@numba.njit(cache=True, nogil=True)
def _search_block(
    row: int,
    block: tuple[int, int, int],
    at: tuple[float, float, float],
    surface: Masks,
    free: Masks,
    best: float,
) -> float:
    """The square of the distance to the nearest unknown voxel of a block, where below ``best``."""
    for byte in range(BLOCK_BYTES):
        seen = int(surface[row, byte] | free[row, byte])
        if seen == _ALL:
            continue
        x = float((block[0] << _SHIFT) + (byte >> _SHIFT))
        y = float((block[1] << _SHIFT) + (byte & (BLOCK_VOXELS - 1)))
        column = _square_gap(at[0], x, 1.0) + _square_gap(at[1], y, 1.0)
        if column >= best:
            continue
        for bit in range(BLOCK_VOXELS):
            if not seen >> bit & 1:
                z = float((block[2] << _SHIFT) + bit)
                best = min(best, column + _square_gap(at[2], z, 1.0))
    return best


@numba.njit(cache=True, nogil=True)
def _search(
    at: tuple[float, float, float],
    blocks: Index,
    surface: Masks,
    free: Masks,
    cells: tuple[int, int],
    limit: float,
) -> float:
    home_x = int(np.floor(at[0])) >> _SHIFT
    home_y = int(np.floor(at[1])) >> _SHIFT
    home_z = int(np.floor(at[2])) >> _SHIFT
    best = limit * limit
    shell = 0
    while shell == 0 or ((shell - 1) * _SIDE) ** 2 < best:
        for x in range(max(home_x - shell, cells[0]), min(home_x + shell + 1, cells[1])):
            for y in range(max(home_y - shell, cells[0]), min(home_y + shell + 1, cells[1])):
                outer = abs(x - home_x) == shell or abs(y - home_y) == shell
                step = 1 if outer else max(1, 2 * shell)
                for z in range(home_z - shell, home_z + shell + 1, step):
                    if not cells[0] <= z < cells[1]:
                        continue
                    square = (
                        _square_gap(at[0], float(x << _SHIFT), _SIDE)
                        + _square_gap(at[1], float(y << _SHIFT), _SIDE)
                        + _square_gap(at[2], float(z << _SHIFT), _SIDE)
                    )
                    if square >= best:
                        continue
                    row = find_row(blocks, pack(x, y, z))
                    if row < 0:
                        best = square
                    else:
                        best = _search_block(row, (x, y, z), at, surface, free, best)
        shell += 1
    return float(np.sqrt(best))


@numba.njit(cache=True, nogil=True)
def find_unknown(
    points: Doubles,
    blocks: Index,
    surface: Masks,
    free: Masks,
    cells: tuple[int, int],
    distances: Doubles,
) -> None:
    """Lower ``distances`` [N] to those from ``points`` [N, 3] to the nearest unknown voxel.

    Points are leaf coordinates of the region, distances are in voxels. Only blocks whose indices
    are in ``range(*cells)`` on each axis are looked at; where there is none, all is unknown.
    """
    for i in range(len(points)):
        at = (points[i, 0], points[i, 1], points[i, 2])
        if max(abs(at[0]), abs(at[1]), abs(at[2])) + distances[i] < CELL_LIMIT:
            distances[i] = _search(at, blocks, surface, free, cells, distances[i])
        else:
            distances[i] = 0.0
