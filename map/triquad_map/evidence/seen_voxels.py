"""The voxels of a region that rays have shown something of, and searches for them.

Kernels stop where the index has no more room; the caller makes room and goes on.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import (
    CELL_LIMIT,
    LOW,
    SHIFT,
    Index,
    bit_of,
    block_key,
    byte_of,
    find_block,
    find_row,
    is_inside,
    make_row,
    pack,
)


class SeenVoxels(NamedTuple):
    """Bit masks in sparse blocks, as kernels take them."""

    side: int  # of the region, voxels
    blocks: Index
    surface: Bytes  # [blocks, BLOCK_BYTES] a ray ended in the voxel
    free: Bytes  # [blocks, BLOCK_BYTES] a ray passed through the voxel


@kernel()
def mark(voxels: Doubles, start: int, seen: SeenVoxels, mask: Bytes, count: int) -> tuple[int, int]:
    """Set the bits of the voxels with points; returns (points done, blocks in use)."""
    for i in range(start, len(voxels)):
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        if not is_inside(x, y, z, seen.side):
            continue
        row = make_row(seen.blocks, count, block_key(x, y, z))
        if row < 0:
            return i, count
        count = max(count, row + 1)
        mask[row, byte_of(x, y)] |= bit_of(z)
    return len(voxels), count


class _Axis(NamedTuple):
    """The points of a grid on one axis, by the voxels that they reach."""

    voxel: int  # the first
    begins: Longs  # [V] first point that reaches each voxel from there on
    ends: Longs  # [V] the point after the last


def surface_in_grid(axes: Sequence[Doubles], reach: float, seen: SeenVoxels) -> Bools:
    """Return which points [X, Y, Z] of a grid have surface voxels within ``reach`` on each axis.

    ``axes`` are their leaf coordinates [X], [Y] and [Z], increasing.
    """
    near = np.zeros([len(axis) for axis in axes], np.bool_)
    if near.size:
        x, y, z = (_axis(axis, reach) for axis in axes)
        _mark(x, y, z, seen, near)
    return near


def _axis(places: Doubles, reach: float) -> _Axis:
    low = np.floor(places - reach).astype(np.int64)
    high = np.floor(places + reach).astype(np.int64)
    voxels = np.arange(low[0], high[-1] + 1)
    begins, ends = np.searchsorted(high, voxels), np.searchsorted(low, voxels, side="right")
    return _Axis(int(low[0]), begins, ends)


@kernel()
def _mark(x: _Axis, y: _Axis, z: _Axis, seen: SeenVoxels, near: Bools) -> None:
    """Mark the points that any surface voxel is reached from, block by block."""
    for i in range(x.voxel >> SHIFT, ((x.voxel + len(x.begins) - 1) >> SHIFT) + 1):
        for j in range(y.voxel >> SHIFT, ((y.voxel + len(y.begins) - 1) >> SHIFT) + 1):
            for k in range(z.voxel >> SHIFT, ((z.voxel + len(z.begins) - 1) >> SHIFT) + 1):
                row = find_block(seen.blocks, i << SHIFT, j << SHIFT, k << SHIFT, seen.side)
                for byte in range(BLOCK_BYTES if row >= 0 else 0):
                    bits = int(seen.surface[row, byte])
                    u = (i << SHIFT) + (byte >> SHIFT) - x.voxel
                    v = (j << SHIFT) + (byte & LOW) - y.voxel
                    if bits == 0 or not (0 <= u < len(x.begins) and 0 <= v < len(y.begins)):
                        continue
                    for inner in range(BLOCK_VOXELS):
                        w = (k << SHIFT) + inner - z.voxel
                        if bits >> inner & 1 and 0 <= w < len(z.begins):
                            for a in range(x.begins[u], x.ends[u]):
                                for b in range(y.begins[v], y.ends[v]):
                                    near[a, b, z.begins[w] : z.ends[w]] = True


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
    """Do as :meth:`triquad_map.evidence.evidence.FrozenEvidence.find_unknown`.

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
