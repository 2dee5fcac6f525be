"""The surfels of a region as a tree of boxes, in which the nearest are searched for.

A leaf has up to eight surfels that are neighbours in a block. Above are blocks, then cubes of
4 x 4 x 4 blocks, then of as many of these, up to one root over all. Which surfels stand where
depends on the voxels in which rays ended alone; their places and the boxes around them are filled
in again with each epoch.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.lanes import LANES, lowest_bit
from triquad_map.compiled.voxel_index import LOW, SHIFT
from triquad_map.surface import DISC_RADIUS, SurfelKind, Surfels

_CUBE_BITS = 6
"""The bits of Morton codes within a node, which has those below it in a cube of 4 x 4 x 4."""

_FAR = np.float32(1e6)
"""The place of lanes without a surfel, in voxels from their block's corner."""

_NOWHERE = np.float32(1e15)
"""Half the side of an empty box, turned inside out."""

Rows = NDArray[np.intp]

_BLOCK_BITS = 3 * SHIFT
_VOXELS = 1 << _BLOCK_BITS
_WORD_BITS = 64
_CODES = morton.encode(
    np.stack(np.meshgrid(*[np.arange(BLOCK_VOXELS)] * 3, indexing="ij"), axis=-1)
).reshape(BLOCK_BYTES, BLOCK_VOXELS)
"""The code of the voxel of each byte and bit of a block's mask."""

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
    corners: Ints  # [blocks, 3] of each block, voxels


class SurfelTree(NamedTuple):
    """A tree with its surfels, in leaf coordinates, as kernels take it.

    Discs have a radius, points none, and no normal.
    """

    order: Ints
    leaves: Ints
    children: Ints
    surfels: Floats  # [leaves, ROWS, LANES] positions are from the corner; far away: none
    boxes: Floats  # [6, leaves + nodes, and room for LANES] least and greatest corners


def tree_shape(cells: Longs, surface: Bytes, starts: Ints) -> TreeShape:
    """Return the tree of the surfels in the voxels in ``surface`` [blocks, BLOCK_BYTES].

    Blocks are at ``cells`` [blocks, 3]; ``starts`` [blocks + 1] are the first surfels of each.
    """
    used = np.flatnonzero(np.diff(starts))
    codes = morton.encode(cells[used])
    blocks = used[np.argsort(codes)]
    codes.sort()
    order, leaves, firsts = _leaves(surface, starts, blocks)
    children, below = [firsts], len(leaves) - 1
    while len(codes) > 1:
        codes >>= _CUBE_BITS
        first = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
        children.append((below + first).astype(np.int32))
        below += len(codes)
        codes = codes[first]
    children.append(np.array([below], np.int32))
    corners = (cells[blocks] * BLOCK_VOXELS).astype(np.int32)
    return TreeShape(order, leaves, np.concatenate(children), corners)


@kernel()
def _leaves(surface: Bytes, starts: Ints, blocks: Rows) -> tuple[Ints, Ints, Ints]:
    """Return the order of surfels, the first of each leaf, and each of ``blocks``' first leaf.

    A leaf is the largest cube, or half or quarter of one, that has no more surfels than lanes.
    """
    order = np.empty(starts[-1], np.int32)
    leaves = np.empty(starts[-1] + 1, np.int32)
    firsts = np.empty(len(blocks), np.int32)
    codes, rows = np.empty((2, _VOXELS), np.int32)
    done, count = 0, 0
    for number, block in enumerate(blocks):
        firsts[number] = count
        end = _order_block(surface[block], starts[block], codes, rows, order[done:])
        at = 0
        while at < end:
            bits = _BLOCK_BITS
            while (at > 0 and codes[at - 1] >> bits == codes[at] >> bits) or (
                at + LANES < end and codes[at + LANES] >> bits == codes[at] >> bits
            ):
                bits -= 1
            leaves[count] = done + at
            count += 1
            cube = codes[at] >> bits
            while at < end and codes[at] >> bits == cube:
                at += 1
        done += end
    leaves[count] = done
    return order, leaves[: count + 1], firsts


@kernel(inline="always")
def _order_block(mask: Bytes, surfel: int, codes: Ints, rows: Ints, order: Ints) -> int:
    """Write Morton codes and numbers of a block's surfels, in this order; return their number.

    The first of them is ``surfel``; ``rows`` is room for the number of each voxel's.
    """
    used = np.zeros(_VOXELS // _WORD_BITS, np.int64)  # a bit for each code
    for byte in range(BLOCK_BYTES):
        bits = int(mask[byte])
        while bits:
            code = _CODES[byte, lowest_bit(bits)]
            used[code // _WORD_BITS] |= 1 << code % _WORD_BITS
            rows[code] = surfel
            surfel += 1
            bits &= bits - 1
    count = 0
    for word in range(len(used)):
        bits = used[word]
        while bits:
            codes[count] = word * _WORD_BITS + lowest_bit(bits)
            order[count] = rows[codes[count]]
            count += 1
            bits &= bits - 1
    return count


def surfel_tree(shape: TreeShape, voxels: Longs, surfels: Surfels) -> SurfelTree:
    """Return the tree of the ``surfels`` [S] of ``voxels`` [S, 3]."""
    leaves, nodes = len(shape.leaves) - 1, len(shape.children) - 1
    tree = SurfelTree(
        shape.order,
        shape.leaves,
        shape.children,
        surfels=np.empty((leaves, ROWS, LANES), np.float32),
        boxes=np.empty((6, leaves + nodes + LANES), np.float32),
    )
    _fill_leaves(tree, shape.corners, voxels, surfels.offsets, surfels.normals, surfels.kinds)
    _fill_nodes(tree.children, tree.boxes, leaves)
    return tree


@kernel(fastmath=True)
def _fill_leaves(
    tree: SurfelTree, corners: Ints, voxels: Longs, offsets: Floats, normals: Floats, kinds: Bytes
) -> None:
    """Fill in the surfels and the boxes of the leaves."""
    order, leaves, rows, boxes = tree.order, tree.leaves, tree.surfels, tree.boxes
    half, one, zero = np.float32(0.5), np.float32(1), np.float32(0)
    for block in range(len(corners)):
        for leaf in range(tree.children[block], tree.children[block + 1]):
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
                corner = np.float32(corners[block, axis])
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
