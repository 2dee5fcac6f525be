"""The vertices of the three planar quadtrees of a region, as kernels find and make them.

A vertex is keyed by plane, level and 2-D Morton code (3QFP, section III-A). One hash table per
plane and level would cost 12 H probes a point, so vertices are kept by *block*, a node of the
coarsest level that carries features: a block holds the rows of all vertices within it and on its
border (4 + 9 + 25 for H = 3), and one probe per plane finds them all. A vertex on a border is in
all blocks that it touches.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Ints, Longs
from triquad_format.records.region import AXES

from triquad_map.compiled.field.morton import encode
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_index import Index, make_row

_AXES = np.array(AXES)
PLANE_BITS = 40
"""Keys of blocks are Morton codes below this bit, and the number of the plane above it."""

NEW_BLOCKS = 27  # at most, of a leaf: 9 on each plane
NEW_ROWS = 48  # and as many vertices: 4 on each plane and level


class Vertices(NamedTuple):
    """The arrays of a tree that grow with it, as kernels take them."""

    blocks: Index  # rows of ``rows``, by the key of a block
    rows: Ints  # [blocks, vertices of a block] of the feature table; 0 for an absent vertex
    codes: Longs  # [rows] Morton code of each vertex
    owners: Bytes  # [rows] its plane and level: ``1 + plane * H + h``


class Shape(NamedTuple):
    """The numbers of a tree that never change."""

    levels: int  # H
    limit: int  # blocks along the side of the cube
    starts: Longs  # [H] first vertex of each level within a block


@kernel(inline="always")
def block_key(plane: int, u: int, v: int) -> int:
    """Key of the block ``(u, v)`` on a plane."""
    key: int = encode(u, v) | (plane << PLANE_BITS)
    return key


@kernel()
def _enter(
    shape: Shape, vertices: Vertices, plane: int, h: int, u: int, v: int, row: int, count: int
) -> int:
    """Give ``row`` to vertex ``(u, v)`` in all blocks that it touches; returns the blocks now."""
    side = (1 << h) + 1
    for block_u in range((u - 1) >> h, (u >> h) + 1):
        for block_v in range((v - 1) >> h, (v >> h) + 1):
            if min(block_u, block_v) < 0 or max(block_u, block_v) >= shape.limit:
                continue
            block = make_row(vertices.blocks, count, block_key(plane, block_u, block_v))
            count = max(count, block + 1)
            local = (u - (block_u << h)) * side + v - (block_v << h)
            vertices.rows[block, shape.starts[h] + local] = row
    vertices.codes[row] = encode(u, v)
    vertices.owners[row] = 1 + plane * shape.levels + h
    return count


@kernel()
def grow_vertices(
    shape: Shape, vertices: Vertices, leaves: Longs, start: int, blocks: int, rows: int
) -> tuple[int, int, int]:
    """Make the nodes that ``leaves`` project into; returns (leaves done, blocks, rows)."""
    for i in range(start, len(leaves)):
        if blocks + NEW_BLOCKS > len(vertices.rows) or rows + NEW_ROWS > len(vertices.codes):
            return i, blocks, rows
        for plane in range(3):
            u, v = leaves[i, _AXES[plane, 0]], leaves[i, _AXES[plane, 1]]
            for h in range(shape.levels):
                down = shape.levels - 1 - h
                node_u, node_v = u >> down, v >> down
                block_u, block_v = node_u >> h, node_v >> h
                block = make_row(vertices.blocks, blocks, block_key(plane, block_u, block_v))
                blocks = max(blocks, block + 1)
                for corner in range(4):
                    corner_u, corner_v = node_u + (corner & 1), node_v + (corner >> 1)
                    local = (corner_u - (block_u << h)) * ((1 << h) + 1) + corner_v - (block_v << h)
                    if vertices.rows[block, shape.starts[h] + local] == 0:
                        blocks = _enter(shape, vertices, plane, h, corner_u, corner_v, rows, blocks)
                        rows += 1
    return len(leaves), blocks, rows


@kernel()
def restore_vertices(
    shape: Shape,
    vertices: Vertices,
    plane: int,
    h: int,
    coordinates: Longs,
    start: int,
    blocks: int,
    rows: int,
) -> tuple[int, int, int]:
    """Give the next rows to vertices [V, 2]; returns (vertices done, blocks, rows)."""
    for i in range(start, len(coordinates)):
        if blocks + NEW_BLOCKS > len(vertices.rows) or rows + NEW_ROWS > len(vertices.codes):
            return i, blocks, rows
        u, v = coordinates[i, 0], coordinates[i, 1]
        blocks = _enter(shape, vertices, plane, h, u, v, rows, blocks)
        rows += 1
    return len(coordinates), blocks, rows
