"""The three planar quadtrees of a region: which vertices exist, and which rows they own.

A vertex is keyed by plane, level and 2-D Morton code (3QFP, section III-A). One hash table per
plane and level would cost 12 H probes a point, so vertices are kept by *block*, a node of the
coarsest level that carries features: a block has the rows of all vertices within it and on its
border (4 + 9 + 25 for H = 3), and one probe per plane finds them all. A vertex on a border is in
all blocks that it touches.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Ints, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import (
    Index,
    VoxelIndex,
    make_row,
    morton_code,
    with_room,
)

_AXES = np.array(AXES)
PLANE_BITS = 40
"""Keys of blocks are Morton codes below this bit, and the number of the plane above it."""

_NEW_BLOCKS = 27  # at most, of a leaf: 9 on each plane
_NEW_ROWS = 48  # and as many vertices: 4 on each plane and level
_NO_BLOCK = -2  # key of row 0, which is found by no other
_MIN_CAPACITY = 256


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
    """Return the key of the block ``(u, v)`` on a plane."""
    key: int = morton_code(u, v) | (plane << PLANE_BITS)
    return key


@inner_kernel()
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
    vertices.codes[row] = morton_code(u, v)
    vertices.owners[row] = 1 + plane * shape.levels + h
    return count


@kernel()
def grow_vertices(
    shape: Shape, vertices: Vertices, leaves: Longs, start: int, blocks: int, rows: int
) -> tuple[int, int, int]:
    """Make the nodes that ``leaves`` project into; returns (leaves done, blocks, rows)."""
    for i in range(start, len(leaves)):
        if blocks + _NEW_BLOCKS > len(vertices.rows) or rows + _NEW_ROWS > len(vertices.codes):
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
        if blocks + _NEW_BLOCKS > len(vertices.rows) or rows + _NEW_ROWS > len(vertices.codes):
            return i, blocks, rows
        u, v = coordinates[i, 0], coordinates[i, 1]
        blocks = _enter(shape, vertices, plane, h, u, v, rows, blocks)
        rows += 1
    return len(coordinates), blocks, rows


@dataclass(frozen=True)
class FrozenQuadtree:
    """The vertices of the three planes at one time, for any thread.

    Row 0 is reserved for absent vertices, and so is block 0, in which all are absent.
    """

    shape: Shape
    vertices: Vertices
    count: int  # rows of the feature table

    def table(self, plane: int, h: int) -> tuple[Longs, Longs]:
        """Return sorted Morton codes [V] and rows [V] of vertices on a plane and level ``h``."""
        owner = 1 + plane * self.shape.levels + h
        rows = np.flatnonzero(self.vertices.owners[: self.count] == owner)
        codes = self.vertices.codes[rows]
        order = np.argsort(codes)
        return codes[order], rows[order]


class LiveQuadtree:
    """Vertices that are added, and the rows of the feature table that they own.

    One thread owns and changes it; :meth:`freeze` gives what others may read.
    """

    def __init__(self, settings: FieldSettings) -> None:
        sides = [(1 << h) + 1 for h in range(settings.feature_levels)]  # vertices along a block
        starts = np.cumsum([0, *(side**2 for side in sides)])
        self.shape = Shape(settings.feature_levels, 1 << settings.levels[0], starts[:-1])
        self._rows = 1
        self._blocks = VoxelIndex(_MIN_CAPACITY)
        self._blocks.arrays.row_keys[0] = _NO_BLOCK
        self._blocks.count = 1
        self.vertices = Vertices(
            self._blocks.arrays,
            np.zeros((_MIN_CAPACITY, starts[-1]), np.int32),
            np.zeros(_MIN_CAPACITY, np.int64),
            np.zeros(_MIN_CAPACITY, np.uint8),
        )
        self._frozen: FrozenQuadtree | None = None  # until the tree grows

    def freeze(self) -> FrozenQuadtree:
        """Return the tree as it is now; the same object until it grows."""
        if self._frozen is None:
            # Codes and owners of rows never change.
            vertices = self.vertices._replace(
                blocks=self._blocks.freeze(), rows=self.vertices.rows[: self._blocks.count].copy()
            )
            self._frozen = FrozenQuadtree(self.shape, vertices, self._rows)
        return self._frozen

    def table(self, plane: int, h: int) -> tuple[Longs, Longs]:
        """Return sorted Morton codes [V] and rows [V] of vertices on a plane and level ``h``."""
        return self.freeze().table(plane, h)

    def grow(self, leaves: Longs) -> int:
        """Make the nodes into which ``leaves`` project; returns how many rows are new.

        Leaves are int64 coordinates [N, 3] in ``[0, 2**depth)``.
        """
        before = self._rows
        self._add(
            len(leaves), lambda *state: grow_vertices(self.shape, self.vertices, leaves, *state)
        )
        return self._rows - before

    def restore(self, plane: int, h: int, codes: Longs) -> None:
        """Give the next rows to the vertices ``codes`` [V] of one level, in their order."""
        places = morton.decode(codes, 2)
        self._add(
            len(places),
            lambda *state: restore_vertices(self.shape, self.vertices, plane, h, places, *state),
        )

    def _add(self, count: int, add: Callable[[int, int, int], tuple[int, int, int]]) -> None:
        """Add ``count`` things by a kernel that stops where there is no more room.

        ``add`` is given how many are done, and the blocks and rows in use; it returns these.
        """
        done = 0
        while done < count:
            self._frozen = None
            done, self._blocks.count, self._rows = add(done, self._blocks.count, self._rows)
            if done < count:
                self._make_room()

    def _make_room(self) -> None:
        """Make room for what one more leaf may need."""
        if self._blocks.count + _NEW_BLOCKS > self._blocks.capacity:
            self._blocks.grow()
            self.vertices = self.vertices._replace(
                blocks=self._blocks.arrays,
                rows=with_room(self.vertices.rows, self._blocks.capacity),
            )
        if self._rows + _NEW_ROWS > len(self.vertices.codes):
            capacity = 2 * len(self.vertices.codes)
            self.vertices = self.vertices._replace(
                codes=with_room(self.vertices.codes, capacity),
                owners=with_room(self.vertices.owners, capacity),
            )
