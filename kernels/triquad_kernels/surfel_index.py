"""The surfels of a region by place, and the search for the nearest.

Surfels stand in the order of the evidence: block by block, and within a block voxel by voxel.
Blocks that hold any are found by groups, cubes of 4 x 4 x 4 blocks, so that empty space costs
nothing.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from triquad_format.region import BLOCK_BYTES, BLOCK_VOXELS
from triquad_query.surfels import DISC_RADIUS, FADED, OUTSIDE, SMOOTHING, SurfelKind

from triquad_kernels.voxel_index import CELL_LIMIT, Index, VoxelIndex, find_row, pack, unpack

_SHIFT = BLOCK_VOXELS.bit_length() - 1
_LOW = BLOCK_VOXELS - 1
_GROUP_SHIFT = 2
_GROUP_VOXELS = float(BLOCK_VOXELS << _GROUP_SHIFT)

_DISC = int(SurfelKind.DISC)
_NONE = int(SurfelKind.NONE)

Masks = NDArray[np.uint8]
Ints = NDArray[np.int32]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Place = tuple[float, float, float]

# What is known of the nearest surfel while it is searched for.
_BEST, _WEIGHT, _FOOT_X, _FOOT_Y, _FOOT_Z, _MEAN_X, _MEAN_Y, _MEAN_Z = range(8)


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
    positions: Floats  # [surfels, 3] from the block's corner, voxels; far away where there is none
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
def _box_distance(at: Place, boxes: Ints, row: int) -> float:
    """How far a point lies at least from the surfels of a box."""
    a = max(boxes[row, 0] - at[0], at[0] - boxes[row, 3], 0.0)
    b = max(boxes[row, 1] - at[1], at[1] - boxes[row, 4], 0.0)
    c = max(boxes[row, 2] - at[2], at[2] - boxes[row, 5], 0.0)
    return float(np.sqrt(a * a + b * b + c * c)) - OUTSIDE


@numba.njit(cache=True, nogil=True, inline="always")
def _reach(state: Doubles) -> float:
    """How near a surfel must lie to count."""
    return float(state[_BEST] + FADED * SMOOTHING)


@numba.njit(cache=True, nogil=True)
def _weigh(
    index: SurfelIndex, surfel: int, offset: Place, square: float, at: Place, state: Doubles
) -> bool:
    """Let a surfel count, given the place ``at`` from it; whether it is the nearest so far."""
    if index.kinds[surfel] == _DISC:
        nx, ny, nz = index.normals[surfel, 0], index.normals[surfel, 1], index.normals[surfel, 2]
        height = offset[0] * nx + offset[1] * ny + offset[2] * nz
        lateral = np.sqrt(max(0.0, square - height * height))
        beyond = max(0.0, lateral - DISC_RADIUS)
        distance = np.sqrt(height * height + beyond * beyond)
        # From the point down to the disc's plane, then back to its rim.
        rim = beyond / max(lateral, 1e-9)
        down = height * (1.0 - rim)
        qx = at[0] - down * nx - rim * offset[0]
        qy = at[1] - down * ny - rim * offset[1]
        qz = at[2] - down * nz - rim * offset[2]
    else:
        distance = np.sqrt(square)
        qx, qy, qz = at[0] - offset[0], at[1] - offset[1], at[2] - offset[2]
    best = state[_BEST]
    if distance > best + FADED * SMOOTHING:
        return False
    nearer: bool = distance < best
    if nearer:
        fade = np.exp((distance - best) / SMOOTHING)
        state[_WEIGHT] *= fade
        state[_MEAN_X] *= fade
        state[_MEAN_Y] *= fade
        state[_MEAN_Z] *= fade
        state[_BEST] = distance
        state[_FOOT_X], state[_FOOT_Y], state[_FOOT_Z] = qx, qy, qz
        best = distance
    weight = np.exp((best - distance) / SMOOTHING)
    state[_WEIGHT] += weight
    state[_MEAN_X] += weight * qx
    state[_MEAN_Y] += weight * qy
    state[_MEAN_Z] += weight * qz
    return nearer


@numba.njit(cache=True, nogil=True)
def _search_block(index: SurfelIndex, member: int, at: Place, state: Doubles, nearest: int) -> int:
    """Look at the surfels of a block; returns the number of the nearest so far."""
    row = index.groups.members[member]
    corner = index.groups.member_boxes[member]
    x = at[0] - float(corner[0] & ~_LOW)
    y = at[1] - float(corner[1] & ~_LOW)
    z = at[2] - float(corner[2] & ~_LOW)
    for surfel in range(index.starts[row], index.starts[row + 1]):
        a = x - index.positions[surfel, 0]
        b = y - index.positions[surfel, 1]
        c = z - index.positions[surfel, 2]
        square = a * a + b * b + c * c
        if square <= (_reach(state) + DISC_RADIUS) ** 2 and _weigh(
            index, surfel, (a, b, c), square, at, state
        ):
            nearest = surfel
    return nearest


@numba.njit(cache=True, nogil=True)
def _search_group(index: SurfelIndex, group: int, at: Place, state: Doubles, nearest: int) -> int:
    """Look at the blocks of a group, the nearest first."""
    boxes = index.groups.member_boxes
    first, least = -1, np.inf
    for member in range(index.groups.starts[group], index.groups.starts[group + 1]):
        distance = _box_distance(at, boxes, member)
        if distance < least:
            first, least = member, distance
    if least > _reach(state):
        return nearest
    nearest = _search_block(index, first, at, state, nearest)
    for member in range(index.groups.starts[group], index.groups.starts[group + 1]):
        if member != first and _box_distance(at, boxes, member) <= _reach(state):
            nearest = _search_block(index, member, at, state, nearest)
    return nearest


@numba.njit(cache=True, nogil=True)
def _search(index: SurfelIndex, at: Place, state: Doubles) -> int:
    """Look at the groups around a point, then at all others; returns the number of the nearest."""
    groups = index.groups
    x = int(np.floor(at[0] / _GROUP_VOXELS))
    y = int(np.floor(at[1] / _GROUP_VOXELS))
    z = int(np.floor(at[2] / _GROUP_VOXELS))
    nearest = -1
    for neighbour in range(27):
        # The own one first: what it holds may keep the others from being looked at.
        number = (neighbour + 13) % 27
        key = pack(x + number // 9 - 1, y + number // 3 % 3 - 1, z + number % 3 - 1)
        group = find_row(groups.places, key)
        if group >= 0 and _box_distance(at, groups.boxes, group) <= _reach(state):
            nearest = _search_group(index, group, at, state, nearest)
    if _reach(state) <= _GROUP_VOXELS:
        return nearest
    for group in range(len(groups.boxes)):
        cell = unpack(groups.places.row_keys[group])
        beyond = max(abs(cell[0] - x), abs(cell[1] - y), abs(cell[2] - z)) > 1
        if beyond and _box_distance(at, groups.boxes, group) <= _reach(state):
            nearest = _search_group(index, group, at, state, nearest)
    return nearest


@numba.njit(cache=True, nogil=True)
def find_nearest(points: Doubles, index: SurfelIndex, found: Nearest) -> None:
    """Improve ``found`` where a surfel of the region lies nearer to ``points`` [N, 3].

    Points are leaf coordinates of the region and may lie outside of it.
    """
    state = np.zeros(8)
    for i in range(len(points)):
        at = (points[i, 0], points[i, 1], points[i, 2])
        state[:] = 0.0
        state[_BEST] = found.distances[i]
        if not max(abs(at[0]), abs(at[1]), abs(at[2])) + _reach(state) < CELL_LIMIT:
            continue
        nearest = _search(index, at, state)
        if nearest >= 0:
            found.distances[i] = state[_BEST]
            for axis in range(3):
                found.feet[i, axis] = state[_FOOT_X + axis]
                found.means[i, axis] = state[_MEAN_X + axis] / state[_WEIGHT]
            found.rows[i] = nearest
