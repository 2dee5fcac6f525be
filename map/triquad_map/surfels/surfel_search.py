"""The search for the nearest surfel.

From the root of the tree down, the nearest box first, and no box that lies farther than the
nearest surfel so far. Boxes and surfels are checked eight at a time. The surfel that was found
for the point before is a first bound: points that follow each other are mostly neighbours.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Ints

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.lanes import (
    LANES,
    Lanes,
    at_most,
    fill,
    larger,
    least,
    load,
    lowest_bit,
    root,
    store,
    total,
    whole,
)
from triquad_map.compiled.voxel_index import CELL_LIMIT
from triquad_map.surface import SMOOTHING
from triquad_map.surfels.surfel_tree import (
    CORNER,
    NORMAL_X,
    NORMAL_Y,
    NORMAL_Z,
    RADIUS,
    SurfelTree,
    X,
    Y,
    Z,
)

_FARTHEST = CELL_LIMIT / 2

_ROUNDING = 2.0**-21
"""The share of their coordinates by which boxes and points are off at most in single precision."""

_SMOOTHING = np.float32(SMOOTHING)
_KEPT = 128
"""The number of leaves that are remembered for the direction."""

_SQUARES = 3
"""The row after x, y and z in what is remembered of each leaf."""

_WHOLE = np.float32(1 << 24) / _KEPT
"""Weights and distances are counted in whole numbers up to this, of which ``_KEPT`` have an exact
sum: it does not depend on the order in which leaves are met, and so on no other point."""

_WAITING = 1024
"""Room for boxes that may have to be opened: seven levels of nodes with 64 below each, and more."""

_NONE = -1
_NO_LENGTH = np.float32(1e-9)

Place = tuple[float, float, float]
Vectors = tuple[Lanes, Lanes, Lanes]


class NearestSurfels(NamedTuple):
    """The nearest surfels of N points of one region, in leaf coordinates; improved in place."""

    distances: Doubles  # [N] voxels; what lies farther than this is not searched for
    closest: Doubles  # [N, 3] their points that are nearest
    means: Doubles  # [N, 3] about the same, over all that is nearly as near
    rows: Ints  # [N] number of the surfel, -1 where there is none


@kernel()
def no_surfels(limits: Doubles) -> NearestSurfels:
    """Return what is known of points before surfels within ``limits`` [N] voxels are found."""
    count = len(limits)
    return NearestSurfels(
        limits.copy(), np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, -1, np.int32)
    )


class Room(NamedTuple):
    """Room for what is known while the nearest surfel of a point is searched for."""

    kept: Ints  # [_KEPT] leaves that may have surfels that count in the direction
    nearest: Floats  # [_KEPT] square of the distance to the nearest surfel of each
    offsets: Floats  # [_KEPT, 4, LANES] from all of each, x, y, z, and the squares of their lengths
    waiting: Ints  # [_WAITING] leaves and nodes that may have nearer surfels, the nearest last
    away: Floats  # [_WAITING] squares of the distances to their boxes
    aside: Floats  # [LANES] room for those of a few boxes


class Found(NamedTuple):
    """The nearest surfel of a point."""

    leaf: int  # that has the nearest surfel, ``_NONE``: there is none
    lane: int  # of this leaf
    square: float  # of the distance to it
    kept: int  # leaves


@inner_kernel(fastmath=True)
def _from_surfels(tree: SurfelTree, leaf: int, at: Place) -> Vectors:
    """Return the vectors from the middles of a leaf's surfels to a place."""
    surfels = tree.surfels
    x = fill(at[0] - surfels[leaf, CORNER, 0]) - load(surfels, (leaf, X, 0))
    y = fill(at[1] - surfels[leaf, CORNER, 1]) - load(surfels, (leaf, Y, 0))
    z = fill(at[2] - surfels[leaf, CORNER, 2]) - load(surfels, (leaf, Z, 0))
    return x, y, z


@inner_kernel(fastmath=True)
def _normals(tree: SurfelTree, leaf: int) -> Vectors:
    surfels = tree.surfels
    return (
        load(surfels, (leaf, NORMAL_X, 0)),
        load(surfels, (leaf, NORMAL_Y, 0)),
        load(surfels, (leaf, NORMAL_Z, 0)),
    )


@inner_kernel(fastmath=True)
def _closest_offset(tree: SurfelTree, leaf: int, at: Place) -> Vectors:
    """Return the vectors to a place from the points of a leaf's surfels that are nearest to it."""
    x, y, z = _from_surfels(tree, leaf, at)
    u, v, w = _normals(tree, leaf)
    height = x * u + y * v + z * w
    u, v, w = height * u, height * v, height * w
    x, y, z = x - u, y - v, z - w
    beside = larger(root(x * x + y * y + z * z), fill(_NO_LENGTH))
    share = larger(fill(1.0) - load(tree.surfels, (leaf, RADIUS, 0)) / beside, fill(0.0))
    return u + share * x, v + share * y, w + share * z


@inner_kernel(fastmath=True)
def _sifted(room: Room, limit: float) -> int:
    """Keep the leaves of which a surfel is within ``limit``; return how many they are."""
    count = 0
    for i in range(_KEPT):
        if room.nearest[i] <= limit:
            room.kept[count], room.nearest[count] = room.kept[i], room.nearest[i]
            for row in range(_SQUARES + 1):
                store(room.offsets, (count, row, 0), load(room.offsets, (i, row, 0)))
            count += 1
    return count


@inner_kernel(fastmath=True)
def _limit(distance: float, at: Place) -> float:
    """Return the square of the distance up to which surfels may count, where one is so near."""
    farthest = max(abs(at[0]), abs(at[1]), abs(at[2])) + distance
    reach = np.float32(distance + SMOOTHING + _ROUNDING * farthest)
    limit: float = reach * reach
    return limit


@inner_kernel(fastmath=True)
def _open(tree: SurfelTree, node: int, at: Place, limit: float, room: Room, count: int) -> int:
    """Add what lies below a node to ``count`` waiting leaves and nodes; return their number."""
    boxes, waiting, away = tree.boxes, room.waiting, room.away
    zero, limits = fill(0.0), fill(limit)
    x, y, z = fill(at[0]), fill(at[1]), fill(at[2])
    before, last = count, tree.children[node + 1]
    for first in range(tree.children[node], last, LANES):
        a = larger(larger(load(boxes, (0, first)) - x, x - load(boxes, (3, first))), zero)
        b = larger(larger(load(boxes, (1, first)) - y, y - load(boxes, (4, first))), zero)
        c = larger(larger(load(boxes, (2, first)) - z, z - load(boxes, (5, first))), zero)
        squares = a * a + b * b + c * c
        store(room.aside, (0,), squares)
        near = at_most(squares, limits)
        if last - first < LANES:
            near &= (1 << (last - first)) - 1
        while near:
            lane = lowest_bit(near)
            near &= near - 1
            box, square = first + lane, room.aside[lane]
            waiting[count], away[count] = box, square
            if count > before and away[count - 1] < square:
                waiting[count], away[count] = waiting[count - 1], away[count - 1]
                waiting[count - 1], away[count - 1] = box, square
            count += 1
    return count


@inner_kernel(fastmath=True)
def _search(tree: SurfelTree, at: Place, distance: float, limit: float, room: Room) -> Found:
    """Search all surfels that are nearer than ``distance``, or count in the direction.

    Those that count are nearer than the root of ``limit``.
    """
    leaves = len(tree.leaves) - 1
    best, leaf, lane, kept = np.float32(distance * distance), _NONE, 0, 0
    room.waiting[0], room.away[0] = leaves + len(tree.children) - 2, 0.0
    count = 1
    while count > 0:
        count -= 1
        if room.away[count] > limit:
            continue
        box = int(room.waiting[count])
        if box >= leaves:
            count = _open(tree, box - leaves, at, limit, room, count)
            continue
        x, y, z = _closest_offset(tree, box, at)
        squares = x * x + y * y + z * z
        nearest = least(squares)
        if nearest > limit:
            continue
        if kept == _KEPT:
            kept = _sifted(room, limit)
        if nearest < best:
            best, leaf = nearest, box
            lane = lowest_bit(at_most(squares, fill(nearest)))
            limit = min(limit, _limit(np.sqrt(nearest), at))
            kept = min(kept, _KEPT - 1)
        if kept < _KEPT:
            room.kept[kept], room.nearest[kept] = box, nearest
            for row, numbers in enumerate((x, y, z, squares)):
                store(room.offsets, (kept, row, 0), numbers)
            kept += 1
    return Found(leaf, lane, best, kept)


@inner_kernel(fastmath=True)
def _write_found(
    tree: SurfelTree, at: Place, found: Found, room: Room, i: int, nearest: NearestSurfels
) -> None:
    """Write what was found for point ``i``."""
    best = np.sqrt(found.square)
    farthest = best + _SMOOTHING
    unit = _WHOLE / farthest
    weights, x, y, z = fill(0.0), fill(0.0), fill(0.0), fill(0.0)
    for k in range(found.kept):
        if room.nearest[k] > farthest * farthest:
            continue
        farther = (root(load(room.offsets, (k, _SQUARES, 0))) - fill(best)) * fill(1 / _SMOOTHING)
        weight = larger(fill(1.0) - farther, fill(0.0))
        weight = weight * weight
        weights = weights + whole(fill(_WHOLE) * weight)
        weight = fill(unit) * weight
        x = x + whole(weight * load(room.offsets, (k, 0, 0)))
        y = y + whole(weight * load(room.offsets, (k, 1, 0)))
        z = z + whole(weight * load(room.offsets, (k, 2, 0)))
        if room.kept[k] == found.leaf:
            for axis in range(3):
                nearest.closest[i, axis] = at[axis] - room.offsets[k, axis, found.lane]
    share = farthest / total(weights)
    nearest.means[i, 0] = at[0] - total(x) * share
    nearest.means[i, 1] = at[1] - total(y) * share
    nearest.means[i, 2] = at[2] - total(z) * share
    nearest.distances[i] = best
    nearest.rows[i] = tree.order[tree.leaves[found.leaf] + found.lane]


@inner_kernel(fastmath=True)
def _first_limit(tree: SurfelTree, at: Place, distance: float, leaf: int) -> float:
    """Do as :func:`_limit`, from how far is searched and a leaf that may be near."""
    if leaf != _NONE:
        x, y, z = _from_surfels(tree, leaf, at)
        distance = min(distance, np.sqrt(least(x * x + y * y + z * z)))
    return _limit(distance, at)


@kernel(fastmath=True)
def find_nearest(points: Doubles, tree: SurfelTree, nearest: NearestSurfels) -> None:
    """Improve ``nearest`` where a surfel of the region lies nearer to ``points`` [N, 3].

    Points are leaf coordinates of the region and may lie outside of it.
    """
    if len(points) == 0 or len(tree.order) == 0:
        return
    room = Room(
        np.empty(_KEPT, np.int32),
        np.empty(_KEPT, np.float32),
        np.empty((_KEPT, _SQUARES + 1, LANES), np.float32),
        np.empty(_WAITING, np.int32),
        np.empty(_WAITING, np.float32),
        np.empty(LANES, np.float32),
    )
    before = np.int64(_NONE)
    for i in range(len(points)):
        at = (points[i, 0], points[i, 1], points[i, 2])
        if not max(abs(at[0]), abs(at[1]), abs(at[2])) < _FARTHEST:
            continue
        limit = _first_limit(tree, at, nearest.distances[i], before)
        found = _search(tree, at, nearest.distances[i], limit, room)
        if found.leaf != _NONE:
            _write_found(tree, at, found, room, i, nearest)
            before = found.leaf
