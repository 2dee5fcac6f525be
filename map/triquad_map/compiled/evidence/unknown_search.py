"""The nearest unknown voxel: no ray ended in it, and none passed through it."""

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import CELL_LIMIT, LOW, SHIFT, find_row, pack

_SIDE = float(BLOCK_VOXELS)
_ALL = 0xFF

Place = tuple[float, float, float]

# What is known of the nearest unknown voxel while it is searched for.
_SQUARE, _X, _Y, _Z = range(4)


@kernel(inline="always")
def _nearest(x: float, low: float, side: float) -> float:
    """Return the place in ``[low, low + side]`` that is nearest to ``x``."""
    return min(max(x, low), low + side)


@kernel(inline="always")
def _square_gap(x: float, low: float, side: float) -> float:
    """Return the square of how far ``x`` lies outside of ``[low, low + side]``."""
    gap = x - _nearest(x, low, side)
    return gap * gap


@kernel(inline="always")
def _take(at: Place, low: Place, side: float, square: float, state: Doubles) -> None:
    """Take an unknown cube as the nearest so far."""
    state[_SQUARE] = square
    state[_X] = _nearest(at[0], low[0], side)
    state[_Y] = _nearest(at[1], low[1], side)
    state[_Z] = _nearest(at[2], low[2], side)


@inner_kernel()
def _search_block(row: int, corner: Place, at: Place, seen: SeenVoxels, state: Doubles) -> None:
    """Search the unknown voxels of a block."""
    for byte in range(BLOCK_BYTES):
        bits = int(seen.surface[row, byte] | seen.free[row, byte])
        if bits == _ALL:
            continue
        x = corner[0] + (byte >> SHIFT)
        y = corner[1] + (byte & LOW)
        column = _square_gap(at[0], x, 1.0) + _square_gap(at[1], y, 1.0)
        if column >= state[_SQUARE]:
            continue
        for bit in range(BLOCK_VOXELS):
            if not bits >> bit & 1:
                z = corner[2] + bit
                square = column + _square_gap(at[2], z, 1.0)
                if square < state[_SQUARE]:
                    _take(at, (x, y, z), 1.0, square, state)


@inner_kernel()
def _search(at: Place, seen: SeenVoxels, cells: tuple[int, int], state: Doubles) -> None:
    """Search the blocks around a point, shell by shell."""
    home_x = int(np.floor(at[0])) >> SHIFT
    home_y = int(np.floor(at[1])) >> SHIFT
    home_z = int(np.floor(at[2])) >> SHIFT
    shell = 0
    while shell == 0 or ((shell - 1) * _SIDE) ** 2 < state[_SQUARE]:
        for x in range(max(home_x - shell, cells[0]), min(home_x + shell + 1, cells[1])):
            for y in range(max(home_y - shell, cells[0]), min(home_y + shell + 1, cells[1])):
                outer = abs(x - home_x) == shell or abs(y - home_y) == shell
                step = 1 if outer else max(1, 2 * shell)
                for z in range(home_z - shell, home_z + shell + 1, step):
                    if not cells[0] <= z < cells[1]:
                        continue
                    low = (x * _SIDE, y * _SIDE, z * _SIDE)
                    square = (
                        _square_gap(at[0], low[0], _SIDE)
                        + _square_gap(at[1], low[1], _SIDE)
                        + _square_gap(at[2], low[2], _SIDE)
                    )
                    if square >= state[_SQUARE]:
                        continue
                    row = find_row(seen.blocks, pack(x, y, z))
                    if row < 0:
                        _take(at, low, _SIDE, square, state)
                    else:
                        _search_block(row, low, at, seen, state)
        shell += 1


@kernel()
def find_unknown(
    points: Doubles, seen: SeenVoxels, cells: tuple[int, int], distances: Doubles, nearest: Doubles
) -> None:
    """Find unknown voxels, see :class:`triquad_map.composition.region.SeenSpace`.

    Only blocks whose indices are in ``range(*cells)`` on each axis are searched; where there is
    none, all is unknown.
    """
    state = np.empty(4)
    for i in range(len(points)):
        at = (points[i, 0], points[i, 1], points[i, 2])
        if not max(abs(at[0]), abs(at[1]), abs(at[2])) + distances[i] < CELL_LIMIT:
            continue
        limit = distances[i] * distances[i]
        state[_SQUARE] = limit
        _search(at, seen, cells, state)
        if state[_SQUARE] < limit:
            distances[i] = np.sqrt(state[_SQUARE])
            for axis in range(3):
                nearest[i, axis] = state[_X + axis]
