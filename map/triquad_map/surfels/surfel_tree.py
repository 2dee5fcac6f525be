"""The surfels of a region as a tree of boxes, in which the nearest are searched for.

A leaf has up to eight surfels that are neighbours in a block. Above are blocks, then cubes of
4 x 4 x 4 blocks, then of as many of these, up to one root over all. Which surfels stand where
depends on the voxels in which rays ended alone; their places and the boxes around them are filled
in again with each epoch.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES, surface_counts

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.lanes import LANES
from triquad_map.compiled.voxel_index import LOW, SHIFT
from triquad_map.surface import DISC_RADIUS, SurfelKind, Surfels

_BLOCK_BITS, _CUBE_BITS = 3 * SHIFT, 6
"""The bits of Morton codes within a block, and of blocks or cubes within the next larger cube."""

_FAR = np.float32(1e6)
"""The place of lanes without a surfel, in voxels from their block's corner."""

_NOWHERE = np.float32(1e15)
"""Half the side of an empty box, turned inside out."""

_NONE, _DISC = int(SurfelKind.NONE), int(SurfelKind.DISC)
_RAY_DISC = int(SurfelKind.RAY_DISC)
_RADIUS = np.float32(DISC_RADIUS)

X, Y, Z, NORMAL_X, NORMAL_Y, NORMAL_Z, RADIUS, CORNER = range(8)
"""The rows of a leaf; in the last are the three coordinates of its block's corner."""

ROWS = 8


class TreeShape(NamedTuple):
    """The structure of a tree: the surfels in each leaf, and the leaves and nodes below each node.

    Leaves come first, then blocks, and so on up to the root, the last; children of a node follow
    each other.
    """

    order: Ints  # [S] the surfels, leaf by leaf
    leaves: Ints  # [leaves + 1] first of each leaf's surfels in ``order``
    children: Ints  # [nodes + 1] first child of each node that is no leaf


class SurfelTree(NamedTuple):
    """A tree with its surfels, in leaf coordinates, as kernels take it.

    Discs have a radius, points none, and no normal.
    """

    order: Ints
    leaves: Ints
    children: Ints
    surfels: Floats  # [leaves, ROWS, LANES] positions are from the corner; far away: none
    boxes: Floats  # [6, leaves + nodes, and room for LANES] least and greatest corners


def tree_shape(voxels: Longs) -> TreeShape:
    """Return the tree of the surfels in ``voxels`` [S, 3]."""
    codes = morton.encode(voxels)
    order = np.argsort(codes)
    codes = codes[order]
    leaves = np.flatnonzero(_begin_leaves(codes))
    children, below, codes = [], 0, codes[leaves] >> _BLOCK_BITS
    while len(codes) > 1:
        first = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
        children.append(below + first)
        below += len(codes)
        codes = codes[first] >> _CUBE_BITS
    return TreeShape(
        order.astype(np.int32),
        np.append(leaves, len(order)).astype(np.int32),
        np.concatenate([*children, [below]]).astype(np.int32),
    )


def _begin_leaves(codes: Longs) -> Bools:
    """Return which of increasing Morton ``codes`` [S] are the first of a leaf.

    A leaf is the largest cube in a block, or half or quarter of one, that has no more surfels than
    lanes.
    """
    # The highest bit in which two codes differ is that of the least cube with both.
    differ = codes[1:] ^ codes[:-1]
    too_many = np.full(len(codes) + LANES - 2, np.iinfo(np.int64).max)
    too_many[LANES - 1 : len(codes) - 1] = codes[LANES:] ^ codes[:-LANES]
    for step in (1, 2, 4):  # the least of each LANES: those around two neighbours
        too_many = np.minimum(too_many[:-step], too_many[step:])
    begins = (differ ^ too_many <= differ) | (differ >> _BLOCK_BITS > 0)
    return np.append(True, begins)[: len(codes)]


@dataclass(frozen=True)
class SurfelPlaces:
    """The places of the surfels of the voxels in which rays ended."""

    cells: Longs  # [blocks, 3]
    surface: Bytes  # [blocks, BLOCK_BYTES] these voxels
    starts: Ints  # [blocks + 1] first surfel of each block
    shape: TreeShape

    def voxels(self) -> Longs:
        """Return the voxel [S, 3] of each surfel, not kept: it takes a quarter of the memory."""
        used = np.flatnonzero(np.diff(self.starts))  # most blocks are of open air
        return surfel_voxels(self.cells[used], self.surface[used], int(self.starts[-1]))


def surfel_places(cells: Longs, surface: Bytes) -> SurfelPlaces:
    """Return places for voxels in ``surface`` [blocks, BLOCK_BYTES] of blocks ``cells`` [, 3]."""
    starts = np.append(0, np.cumsum(surface_counts(surface))).astype(np.int32)
    shape = tree_shape(surfel_voxels(cells, surface, int(starts[-1])))
    return SurfelPlaces(cells, surface, starts, shape)


@kernel()
def surfel_voxels(cells: Longs, surface: Bytes, count: int) -> Longs:
    """Return the voxels [count, 3] of surfels, given the blocks' ``cells`` [blocks, 3]."""
    voxels = np.empty((count, 3), np.int64)
    at = 0
    for row in range(len(surface)):
        for byte in range(BLOCK_BYTES):
            bits = int(surface[row, byte])
            if bits == 0:  # as in most blocks, which are of open air
                continue
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    voxels[at, 0] = (cells[row, 0] << SHIFT) + (byte >> SHIFT)
                    voxels[at, 1] = (cells[row, 1] << SHIFT) + (byte & LOW)
                    voxels[at, 2] = (cells[row, 2] << SHIFT) + z
                    at += 1
    return voxels


def surfel_tree(shape: TreeShape, voxels: Longs, surfels: Surfels) -> SurfelTree:
    """Return the tree of the ``surfels`` [S] of ``voxels`` [S, 3]."""
    leaves, nodes = len(shape.leaves) - 1, len(shape.children) - 1
    tree = SurfelTree(
        *shape,
        surfels=np.empty((leaves, ROWS, LANES), np.float32),
        boxes=np.empty((6, leaves + nodes + LANES), np.float32),
    )
    _fill_leaves(tree, voxels, surfels.offsets, surfels.normals, surfels.kinds)
    _fill_nodes(tree.children, tree.boxes, leaves)
    return tree


@kernel(fastmath=True)
def _fill_leaves(
    tree: SurfelTree, voxels: Longs, offsets: Floats, normals: Floats, kinds: Bytes
) -> None:
    """Fill in the surfels and the boxes of the leaves."""
    order, leaves, rows, boxes = tree.order, tree.leaves, tree.surfels, tree.boxes
    half, one, zero = np.float32(0.5), np.float32(1), np.float32(0)
    for leaf in range(len(rows)):
        first, last = leaves[leaf], leaves[leaf + 1]
        for lane in range(LANES):
            surfel = order[min(first + lane, last - 1)]
            is_none = first + lane >= last or kinds[surfel] == _NONE
            is_disc = kinds[surfel] == _DISC or kinds[surfel] == _RAY_DISC
            rows[leaf, RADIUS, lane] = _RADIUS if is_disc else zero
            for axis in range(3):
                place = np.float32(voxels[surfel, axis] & LOW) + half + offsets[surfel, axis]
                rows[leaf, X + axis, lane] = _FAR if is_none else place
                rows[leaf, NORMAL_X + axis, lane] = normals[surfel, axis] if is_disc else zero
        for axis in range(3):
            corner = np.float32(voxels[order[first], axis] & ~LOW)
            rows[leaf, CORNER, axis] = corner
            low, high = _NOWHERE, -_NOWHERE
            for lane in range(LANES):
                place, normal = rows[leaf, X + axis, lane], rows[leaf, NORMAL_X + axis, lane]
                across = np.sqrt(max(one - normal * normal, zero)) * rows[leaf, RADIUS, lane]
                if place < _FAR:
                    low, high = min(low, place - across), max(high, place + across)
            boxes[axis, leaf], boxes[axis + 3, leaf] = low + corner, high + corner


@kernel(fastmath=True)
def _fill_nodes(children: Ints, boxes: Floats, leaves: int) -> None:
    """Fill in the boxes around the children of each node."""
    for node in range(len(children) - 1):
        for axis in range(3):
            low, high = _NOWHERE, -_NOWHERE
            for child in range(children[node], children[node + 1]):
                low, high = min(low, boxes[axis, child]), max(high, boxes[axis + 3, child])
            boxes[axis, leaves + node], boxes[axis + 3, leaves + node] = low, high
