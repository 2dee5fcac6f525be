"""The surfels of a region by place, and the search for the nearest.

Surfels stand in the order of the evidence: block by block, and within a block voxel by voxel.
Blocks that hold any are found by groups, cubes of 4 x 4 x 4 blocks, so that empty space costs
nothing.
"""

import itertools
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from triquad_format.region import BLOCK_BYTES, BLOCK_VOXELS
from triquad_query.surfels import DISC_RADIUS, OUTSIDE, SMOOTHING, SurfelKind

from triquad_kernels.voxel_index import CELL_LIMIT, Index, VoxelIndex, find_row, pack, unpack

_SHIFT = BLOCK_VOXELS.bit_length() - 1
_LOW = BLOCK_VOXELS - 1
_GROUP_SHIFT = 2
_GROUP_VOXELS = float(BLOCK_VOXELS << _GROUP_SHIFT)

_STEPS = np.array(
    sorted(itertools.product((-1, 0, 1), repeat=3), key=lambda step: np.abs(step).sum())
)
"""To the groups at and beside a place [27, 3], the near ones first."""

_NEIGHBOURS = len(_STEPS)

_CANDIDATES = 128
"""How many of them are kept in mind."""

_DISC = int(SurfelKind.DISC)
_RADIUS = np.float32(DISC_RADIUS)

Masks = NDArray[np.uint8]
Ints = NDArray[np.int32]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Place = tuple[float, float, float]

# The numbers of ``Search.state``.
_BEST, _FOOT_X, _FOOT_Y, _FOOT_Z, _COUNT = range(5)


class Search(NamedTuple):
    """What is known while the nearest surfel of a point is searched for."""

    state: Doubles  # [5] least distance, its foot, number of candidates
    candidates: Doubles  # [_CANDIDATES, 4] distances and feet of what may count in the direction
    squares: Floats  # [BLOCK_VOXELS**3] room for squares of distances to surfels
    away: Doubles  # [blocks of a group] and to the boxes of blocks


class BlockGroups(NamedTuple):
    """The blocks that hold seen surface, in groups, with the boxes around that.

    A box is its least and its greatest corner, in voxels; surfels reach ``OUTSIDE`` of it.
    """

    places: Index  # of groups
    boxes: Ints  # [groups, 6]
    starts: Ints  # [groups + 1] first member of each
    members: Ints  # [M] rows of blocks
    member_boxes: Ints  # [M, 6]


class SurfelIndex(NamedTuple):
    """Surfels as kernels take them."""

    groups: BlockGroups
    starts: Ints  # [blocks + 1] first surfel of each block
    positions: Floats  # [3, surfels] from the block's corner, voxels; far away where there is none
    normals: Floats  # [surfels, 3]
    kinds: Masks  # [surfels] SurfelKind


class Nearest(NamedTuple):
    """The nearest surfels of N points, in leaf coordinates; kernels improve on what is there."""

    distances: Doubles  # [N] voxels; what lies farther than this at first is not looked for
    feet: Doubles  # [N, 3] the nearest point
    means: Doubles  # [N, 3] about the same, over all that is nearly as near
    rows: NDArray[np.int32]  # [N] number of the surfel, -1 where there is none


def surfel_starts(surface: Masks) -> Ints:
    """The first surfel [blocks + 1] of the voxels in ``surface`` [blocks, BLOCK_BYTES]."""
    counts = np.unpackbits(surface, axis=1).sum(axis=1, dtype=np.int32)
    return np.concatenate([np.zeros(1, np.int32), np.cumsum(counts, dtype=np.int32)])


@numba.njit(cache=True, nogil=True)
def surfel_voxels(cells: NDArray[np.int64], surface: Masks, count: int) -> NDArray[np.int64]:
    """The voxels [count, 3] of surfels, given the blocks' ``cells`` [blocks, 3]."""
    voxels = np.empty((count, 3), np.int64)
    at = 0
    for row in range(len(surface)):
        for byte in range(BLOCK_BYTES):
            bits = int(surface[row, byte])
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    voxels[at, 0] = (cells[row, 0] << _SHIFT) + (byte >> _SHIFT)
                    voxels[at, 1] = (cells[row, 1] << _SHIFT) + (byte & _LOW)
                    voxels[at, 2] = (cells[row, 2] << _SHIFT) + z
                    at += 1
    return voxels


@numba.njit(cache=True, nogil=True)
def moved_rows(
    before: Masks, before_starts: NDArray[np.int32], now: Masks, count: int
) -> NDArray[np.int32]:
    """For each surfel [count] of ``now``, its number in ``before``; -1 where it is new.

    Blocks are those of ``before`` and more.
    """
    rows = np.full(count, -1, np.int32)
    at = 0
    for row in range(len(now)):
        known = row < len(before)
        old = before_starts[row] if known else 0
        for byte in range(BLOCK_BYTES):
            bits = int(now[row, byte])
            old_bits = int(before[row, byte]) if known else 0
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    if old_bits >> z & 1:
                        rows[at] = old
                    at += 1
                old += old_bits >> z & 1
    return rows


@numba.njit(cache=True, nogil=True)
def _block_boxes(cells: NDArray[np.int64], surface: Masks, rows: NDArray[np.int64]) -> Ints:
    """The boxes [M, 6] around the seen surface of some blocks."""
    boxes = np.empty((len(rows), 6), np.int32)
    for i, row in enumerate(rows):
        for axis in range(3):
            boxes[i, axis], boxes[i, axis + 3] = BLOCK_VOXELS, 0
        for byte in range(BLOCK_BYTES):
            for z in range(BLOCK_VOXELS):
                if surface[row, byte] >> z & 1:
                    for axis, place in enumerate((byte >> _SHIFT, byte & _LOW, z)):
                        boxes[i, axis] = min(boxes[i, axis], place)
                        boxes[i, axis + 3] = max(boxes[i, axis + 3], place + 1)
        for side in range(6):
            boxes[i, side] += cells[row, side % 3] << _SHIFT
    return boxes


def block_groups(cells: NDArray[np.int64], surface: Masks) -> BlockGroups:
    """The blocks at ``cells`` [blocks, 3] that hold any of ``surface``, in groups."""
    used = np.flatnonzero(surface.any(axis=1))
    places = cells[used] >> _GROUP_SHIFT
    groups, owners = np.unique(places, axis=0, return_inverse=True)
    order = np.argsort(owners.reshape(-1), kind="stable")
    starts = np.searchsorted(owners.reshape(-1)[order], np.arange(len(groups) + 1))
    boxes = _block_boxes(cells, surface, used[order])
    around = np.zeros((len(groups), 6), np.int32)
    if len(groups):
        around[:, :3] = np.minimum.reduceat(boxes[:, :3], starts[:-1])
        around[:, 3:] = np.maximum.reduceat(boxes[:, 3:], starts[:-1])
    return BlockGroups(
        VoxelIndex.of_cells(groups).arrays,
        around,
        starts.astype(np.int32),
        used[order].astype(np.int32),
        boxes,
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _square_to_box(at: Place, boxes: Ints, row: int) -> float:
    """Square of how far a point lies outside of a box."""
    a = max(boxes[row, 0] - at[0], at[0] - boxes[row, 3], 0.0)
    b = max(boxes[row, 1] - at[1], at[1] - boxes[row, 4], 0.0)
    c = max(boxes[row, 2] - at[2], at[2] - boxes[row, 5], 0.0)
    return float(a * a + b * b + c * c)


@numba.njit(cache=True, nogil=True, inline="always")
def _square_reach(best: float) -> float:
    """Square of how far a box may be that still holds a surfel which counts."""
    reach = best + SMOOTHING + OUTSIDE
    return reach * reach


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _search_block(
    index: SurfelIndex, span: tuple[int, int], corner: Place, at: Place, search: Search
) -> int:
    """Look at the surfels ``range(*span)`` of a block; the nearest, or -1: none is nearer.

    Everything is relative to the block's corner, in single precision, and in local variables: to
    reach into tuples of arrays for every surfel would take longer than the arithmetic.
    """
    state, candidates, squares = search.state, search.candidates, search.squares
    normals, kinds = index.normals, index.kinds
    start, count = span[0], span[1] - span[0]
    # Slices of their own, which the compiler makes vector instructions of.
    xs = index.positions[0, start : start + count]
    ys = index.positions[1, start : start + count]
    zs = index.positions[2, start : start + count]
    x, y, z = (
        np.float32(at[0] - corner[0]),
        np.float32(at[1] - corner[1]),
        np.float32(at[2] - corner[2]),
    )
    for i in range(count):
        a, b, c = x - xs[i], y - ys[i], z - zs[i]
        squares[i] = a * a + b * b + c * c
    best, noted, nearest = state[_BEST], int(state[_COUNT]), -1
    sifted = np.inf  # the least distance when candidates were last left out
    for i in range(count):
        if squares[i] > (best + SMOOTHING + DISC_RADIUS) ** 2:
            continue
        surfel = start + i
        a, b, c = x - xs[i], y - ys[i], z - zs[i]
        nx, ny, nz = normals[surfel, 0], normals[surfel, 1], normals[surfel, 2]
        height = a * nx + b * ny + c * nz
        square, beside = squares[i], squares[i] - height * height
        down, rim = height, np.float32(0)  # to the disc's plane, and back to its rim
        if kinds[surfel] != _DISC:
            down, rim = np.float32(0), np.float32(1)
        elif beside <= _RADIUS * _RADIUS:
            square = height * height
        else:
            lateral = np.sqrt(beside)
            square = height * height + (lateral - _RADIUS) ** 2
            rim = np.float32(1) - _RADIUS / lateral
            down = height * (np.float32(1) - rim)
        if square > (best + SMOOTHING) ** 2:
            continue
        distance = np.sqrt(np.float64(square))
        if noted == _CANDIDATES and best < sifted:
            noted, sifted = _still_near(candidates, best + SMOOTHING), best
        if noted == _CANDIDATES and distance >= best:
            continue  # there are enough
        at_most = min(noted, _CANDIDATES - 1)
        candidates[at_most, 0] = distance
        candidates[at_most, 1] = at[0] - (down * nx + rim * a)
        candidates[at_most, 2] = at[1] - (down * ny + rim * b)
        candidates[at_most, 3] = at[2] - (down * nz + rim * c)
        if distance < best:
            best, nearest = distance, surfel
            for axis in range(3):
                state[_FOOT_X + axis] = candidates[at_most, axis + 1]
        noted = at_most + 1
    state[_BEST], state[_COUNT] = best, noted
    return nearest


@numba.njit(cache=True, nogil=True)
def _still_near(candidates: Doubles, limit: float) -> int:
    """Keep the candidates that are nearer than ``limit``; returns how many they are."""
    count = 0
    for i in range(len(candidates)):
        if candidates[i, 0] <= limit:
            candidates[count] = candidates[i]
            count += 1
    return count


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _search_group(index: SurfelIndex, group: int, at: Place, search: Search) -> int:
    """Look at the blocks of a group, the nearest first; the nearest surfel, or -1."""
    boxes, members, starts = index.groups.member_boxes, index.groups.members, index.starts
    away, state = search.away, search.state
    first = index.groups.starts[group]
    count = index.groups.starts[group + 1] - first
    for i in range(count):
        away[i] = _square_to_box(at, boxes, first + i)
    begin = int(np.argmin(away[:count]))
    nearest = -1
    for turn in range(-1, count):
        i = begin if turn < 0 else turn
        if turn == begin or away[i] > _square_reach(state[_BEST]):
            continue
        member = first + i
        corner = (
            float(boxes[member, 0] & ~_LOW),
            float(boxes[member, 1] & ~_LOW),
            float(boxes[member, 2] & ~_LOW),
        )
        row = members[member]
        found = _search_block(index, (starts[row], starts[row + 1]), corner, at, search)
        nearest = found if found >= 0 else nearest
    return nearest


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _search(index: SurfelIndex, at: Place, search: Search) -> int:
    """Look at the groups around a point, then at all others; the nearest surfel, or -1.

    All of this becomes one function: to pass so many arrays on takes a fifth of the time.
    """
    state, places, boxes = search.state, index.groups.places, index.groups.boxes
    x = int(np.floor(at[0] / _GROUP_VOXELS))
    y = int(np.floor(at[1] / _GROUP_VOXELS))
    z = int(np.floor(at[2] / _GROUP_VOXELS))
    nearest = -1
    for turn in range(_NEIGHBOURS):
        key = pack(x + _STEPS[turn, 0], y + _STEPS[turn, 1], z + _STEPS[turn, 2])
        group = find_row(places, key)
        if group >= 0 and _square_to_box(at, boxes, group) <= _square_reach(state[_BEST]):
            found = _search_group(index, group, at, search)
            nearest = found if found >= 0 else nearest
    if state[_BEST] + SMOOTHING <= _GROUP_VOXELS:
        return nearest
    for group in range(len(boxes)):
        if _square_to_box(at, boxes, group) > _square_reach(state[_BEST]):
            continue
        a, b, c = unpack(places.row_keys[group])
        if max(abs(a - x), abs(b - y), abs(c - z)) > 1:  # not looked at yet
            found = _search_group(index, group, at, search)
            nearest = found if found >= 0 else nearest
    return nearest


@numba.njit(cache=True, nogil=True, inline="always")
def _set_mean(search: Search, mean: Doubles) -> None:
    """The mean [3] of all that is nearly as near as the nearest."""
    total = 0.0
    mean[:] = 0.0
    for i in range(int(search.state[_COUNT])):
        share = 1.0 - (search.candidates[i, 0] - search.state[_BEST]) / SMOOTHING
        if share > 0.0:
            weight = share * share
            total += weight
            for axis in range(3):
                mean[axis] += weight * search.candidates[i, axis + 1]
    mean /= total


@numba.njit(cache=True, nogil=True, fastmath=True)
def find_nearest(points: Doubles, index: SurfelIndex, found: Nearest) -> None:
    """Improve ``found`` where a surfel of the region lies nearer to ``points`` [N, 3].

    Points are leaf coordinates of the region and may lie outside of it.
    """
    search = Search(
        np.zeros(5),
        np.empty((_CANDIDATES, 4)),
        np.empty(BLOCK_VOXELS**3, np.float32),
        np.empty(1 << 3 * _GROUP_SHIFT),
    )
    for i in range(len(points)):
        at = (points[i, 0], points[i, 1], points[i, 2])
        search.state[:] = 0.0
        search.state[_BEST] = found.distances[i]
        if (
            not max(abs(at[0]), abs(at[1]), abs(at[2])) + search.state[_BEST] + SMOOTHING
            < CELL_LIMIT
        ):
            continue
        nearest = _search(index, at, search)
        if nearest >= 0:
            found.distances[i] = search.state[_BEST]
            for axis in range(3):
                found.feet[i, axis] = search.state[_FOOT_X + axis]
            _set_mean(search, found.means[i])
            found.rows[i] = nearest
