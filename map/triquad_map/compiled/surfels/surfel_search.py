"""The search for the nearest surfel.

Groups of blocks first, cubes of 4 x 4 x 4, so that empty space costs nothing; then their blocks,
then the surfels of a block, each level by the boxes around what it holds. All of it becomes one
function, and arrays are in local variables where a loop uses them: to pass them on, or to reach
into tuples for them, takes longer than the arithmetic.
"""

import itertools
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints
from triquad_format.records.field_settings import BLOCK_VOXELS

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import CELL_LIMIT, LOW, Index, find_row, pack, unpack
from triquad_map.composition.region import NearestSurfels
from triquad_map.surface import DISC_RADIUS, OUTSIDE, SMOOTHING, SurfelKind

GROUP_SHIFT = 2
_GROUP_VOXELS = float(BLOCK_VOXELS << GROUP_SHIFT)

_STEPS = np.array(
    sorted(itertools.product((-1, 0, 1), repeat=3), key=lambda step: np.abs(step).sum())
)
"""To the groups at and beside a place [27, 3], the near ones first."""

_NEIGHBOURS = len(_STEPS)
_FARTHEST = CELL_LIMIT / 2
_DISC, _RAY_DISC = int(SurfelKind.DISC), int(SurfelKind.RAY_DISC)
_RADIUS = np.float32(DISC_RADIUS)

_CANDIDATES = 128
"""How many surfels are remembered for the direction."""

_NONE = -1

# The numbers of ``Search.found``.
_SURFEL, _MEMBER, _COUNT = range(3)

Place = tuple[float, float, float]


class BlockGroups(NamedTuple):
    """The blocks that hold seen surface, in groups, with the boxes around that.

    A box is its least and its greatest corner, in voxels; surfels reach ``OUTSIDE`` of it.
    """

    places: Index  # of groups
    boxes: Ints  # [groups, 6]
    starts: Ints  # [groups + 1] first member of each
    members: Ints  # [M] rows of blocks
    member_boxes: Floats  # [6, M]


class SurfelIndex(NamedTuple):
    """Surfels as kernels take them."""

    groups: BlockGroups
    starts: Ints  # [blocks + 1] first surfel of each block
    positions: Floats  # [3, surfels] from the block's corner, voxels; far away where there is none
    normals: Floats  # [surfels, 3]
    kinds: Bytes  # [surfels] SurfelKind


class Search(NamedTuple):
    """What is known while the nearest surfel of a point is searched for."""

    best: Floats  # [1] square of the least distance
    found: Ints  # [3] the nearest surfel, the block that holds it, and how many candidates
    candidates: Ints  # [_CANDIDATES, 2] surfels that may count in the direction, and their blocks
    nearness: Floats  # [_CANDIDATES] squares of their distances
    squares: Floats  # [BLOCK_VOXELS**3] room for those of a block's surfels
    away: Floats  # [blocks of a group] and for those of blocks


@kernel(fastmath=True, inline="always")
def _wider(square: float, by: float) -> float:
    """Square of a distance that is larger ``by`` so much."""
    reach = np.sqrt(square) + np.float32(by)
    wider: float = np.float32(reach * reach)
    return wider


@kernel(fastmath=True, inline="always")
def _sifted(search: Search, limit: float) -> int:
    """Keep the candidates that are nearer than the root of ``limit``; how many they are."""
    candidates, nearness = search.candidates, search.nearness
    count = 0
    for i in range(_CANDIDATES):
        if nearness[i] <= limit:
            nearness[count] = nearness[i]
            candidates[count, 0], candidates[count, 1] = candidates[i, 0], candidates[i, 1]
            count += 1
    return count


@kernel(fastmath=True, inline="always")
def _disc_square(a: float, b: float, c: float, normal: Floats, square: float) -> float:
    """Square of the distance to a disc, of whose middle a place is ``(a, b, c)`` off."""
    height = a * normal[0] + b * normal[1] + c * normal[2]
    beside = square - height * height
    square = height * height
    if beside > _RADIUS * _RADIUS:
        beyond = np.sqrt(beside) - _RADIUS
        square += beyond * beyond
    return square


@kernel(fastmath=True, inline="always")
def _search_block(index: SurfelIndex, member: int, at: Place, search: Search) -> None:
    """Search the surfels of a block. All is relative to its corner, in single precision."""
    row, boxes = index.groups.members[member], index.groups.member_boxes
    x = np.float32(at[0] - (int(boxes[0, member]) & ~LOW))
    y = np.float32(at[1] - (int(boxes[1, member]) & ~LOW))
    z = np.float32(at[2] - (int(boxes[2, member]) & ~LOW))
    start, count = index.starts[row], index.starts[row + 1] - index.starts[row]
    # Slices of their own, which the compiler makes vector instructions of.
    xs = index.positions[0, start : start + count]
    ys = index.positions[1, start : start + count]
    zs = index.positions[2, start : start + count]
    normals, kinds, squares = index.normals, index.kinds, search.squares
    for i in range(count):
        a, b, c = x - xs[i], y - ys[i], z - zs[i]
        squares[i] = a * a + b * b + c * c
    best, known = search.best[0], search.found[_COUNT]
    near, far = _wider(best, SMOOTHING), _wider(best, SMOOTHING + DISC_RADIUS)
    sifted = best
    for i in range(count):
        if squares[i] > far:
            continue
        surfel, square = start + i, squares[i]
        if kinds[surfel] == _DISC or kinds[surfel] == _RAY_DISC:
            square = _disc_square(x - xs[i], y - ys[i], z - zs[i], normals[surfel], square)
        if square > near:
            continue
        if known == _CANDIDATES and best < sifted:
            known, sifted = _sifted(search, near), best
        if known < _CANDIDATES:
            search.candidates[known, 0], search.candidates[known, 1] = surfel, member
            search.nearness[known] = square
            known += 1
        if square < best:
            best = square
            search.found[_SURFEL], search.found[_MEMBER] = surfel, member
            near, far = _wider(best, SMOOTHING), _wider(best, SMOOTHING + DISC_RADIUS)
    search.best[0], search.found[_COUNT] = best, known


@kernel(fastmath=True, inline="always")
def _search_group(index: SurfelIndex, group: int, at: Place, search: Search) -> None:
    """Search the blocks of a group, the nearest first."""
    first, last = index.groups.starts[group], index.groups.starts[group + 1]
    boxes, away = index.groups.member_boxes, search.away
    x0, y0, z0 = boxes[0, first:last], boxes[1, first:last], boxes[2, first:last]
    x1, y1, z1 = boxes[3, first:last], boxes[4, first:last], boxes[5, first:last]
    x, y, z = np.float32(at[0]), np.float32(at[1]), np.float32(at[2])
    zero = np.float32(0)
    for i in range(last - first):
        a = max(x0[i] - x, x - x1[i], zero)
        b = max(y0[i] - y, y - y1[i], zero)
        c = max(z0[i] - z, z - z1[i], zero)
        away[i] = a * a + b * b + c * c
    begin = 0
    for i in range(1, last - first):
        if away[i] < away[begin]:
            begin = i
    limit = _wider(search.best[0], SMOOTHING + OUTSIDE)
    for turn in range(-1, last - first):
        i = begin if turn < 0 else turn
        if turn != begin and away[i] <= limit:
            _search_block(index, first + i, at, search)
            limit = _wider(search.best[0], SMOOTHING + OUTSIDE)


@kernel(inline="always")
def _reaches(index: SurfelIndex, group: int, at: Place, search: Search) -> bool:
    """Whether a group may hold a surfel that counts."""
    boxes = index.groups.boxes
    a = max(boxes[group, 0] - at[0], at[0] - boxes[group, 3], 0.0)
    b = max(boxes[group, 1] - at[1], at[1] - boxes[group, 4], 0.0)
    c = max(boxes[group, 2] - at[2], at[2] - boxes[group, 5], 0.0)
    return bool(a * a + b * b + c * c <= _wider(search.best[0], SMOOTHING + OUTSIDE))


@kernel(fastmath=True, inline="always")
def _search(index: SurfelIndex, at: Place, search: Search) -> None:
    """Search the groups around a point, then at all others."""
    places = index.groups.places
    x = int(np.floor(at[0] / _GROUP_VOXELS))
    y = int(np.floor(at[1] / _GROUP_VOXELS))
    z = int(np.floor(at[2] / _GROUP_VOXELS))
    for turn in range(_NEIGHBOURS + len(index.groups.boxes)):
        if turn < _NEIGHBOURS:
            key = pack(x + _STEPS[turn, 0], y + _STEPS[turn, 1], z + _STEPS[turn, 2])
            group = find_row(places, key)
        elif _wider(search.best[0], SMOOTHING) <= _GROUP_VOXELS * _GROUP_VOXELS:
            break
        else:
            group = turn - _NEIGHBOURS
            a, b, c = unpack(places.row_keys[group])
            if max(abs(a - x), abs(b - y), abs(c - z)) <= 1:  # searched already
                continue
        if group >= 0 and _reaches(index, group, at, search):
            _search_group(index, group, at, search)


@kernel(inline="always")
def _closest_point(index: SurfelIndex, surfel: int, member: int, at: Place) -> Place:
    """The point of a surfel that is nearest to a place."""
    boxes = index.groups.member_boxes
    qx = (int(boxes[0, member]) & ~LOW) + float(index.positions[0, surfel])
    qy = (int(boxes[1, member]) & ~LOW) + float(index.positions[1, surfel])
    qz = (int(boxes[2, member]) & ~LOW) + float(index.positions[2, surfel])
    if index.kinds[surfel] != _DISC and index.kinds[surfel] != _RAY_DISC:
        return qx, qy, qz
    nx, ny, nz = index.normals[surfel, 0], index.normals[surfel, 1], index.normals[surfel, 2]
    a, b, c = at[0] - qx, at[1] - qy, at[2] - qz
    height = a * nx + b * ny + c * nz
    a, b, c = a - height * nx, b - height * ny, c - height * nz
    share = min(1.0, DISC_RADIUS / max(np.sqrt(a * a + b * b + c * c), 1e-9))
    return qx + share * a, qy + share * b, qz + share * c


@kernel()
def _write_found(
    index: SurfelIndex, at: Place, search: Search, i: int, nearest: NearestSurfels
) -> None:
    """Write what was found for point ``i``."""
    best = np.sqrt(search.best[0])
    surfel = search.found[_SURFEL]
    closest = _closest_point(index, surfel, search.found[_MEMBER], at)
    total, x, y, z = 1.0, closest[0], closest[1], closest[2]
    for k in range(search.found[_COUNT]):
        share = 1.0 - (np.sqrt(search.nearness[k]) - best) / SMOOTHING
        if share > 0.0 and search.candidates[k, 0] != surfel:
            a, b, c = _closest_point(index, search.candidates[k, 0], search.candidates[k, 1], at)
            weight = share * share
            total += weight
            x, y, z = x + weight * a, y + weight * b, z + weight * c
    nearest.distances[i] = best
    nearest.rows[i] = surfel
    nearest.closest[i, 0], nearest.closest[i, 1], nearest.closest[i, 2] = closest
    nearest.means[i, 0] = x / total
    nearest.means[i, 1] = y / total
    nearest.means[i, 2] = z / total


@kernel()
def find_nearest(points: Doubles, index: SurfelIndex, nearest: NearestSurfels) -> None:
    """Improve ``nearest`` where a surfel of the region lies nearer to ``points`` [N, 3].

    Points are leaf coordinates of the region and may lie outside of it.
    """
    search = Search(
        np.empty(1, np.float32),
        np.empty(3, np.int32),
        np.empty((_CANDIDATES, 2), np.int32),
        np.empty(_CANDIDATES, np.float32),
        np.empty(BLOCK_VOXELS**3, np.float32),
        np.empty(1 << 3 * GROUP_SHIFT, np.float32),
    )
    for i in range(len(points)):
        at = (points[i, 0], points[i, 1], points[i, 2])
        if not max(abs(at[0]), abs(at[1]), abs(at[2])) < _FARTHEST:
            continue
        search.best[0] = nearest.distances[i] ** 2
        search.found[_SURFEL], search.found[_COUNT] = _NONE, 0
        _search(index, at, search)
        if search.found[_SURFEL] != _NONE:
            _write_found(index, at, search, i, nearest)
