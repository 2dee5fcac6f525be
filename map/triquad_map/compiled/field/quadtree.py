"""The three planar quadtrees of a region: which vertices exist, and which a point lies between.

A vertex is keyed by plane, level and 2-D Morton code (3QFP, section III-A). One hash table per
plane and level would cost 12 H probes a point, so vertices are kept by *block*, a node of the
coarsest level that carries features: a block holds the rows of all vertices within it and on its
border (4 + 9 + 25 for H = 3), and one probe per plane finds them all. A vertex on a border is in
all blocks that it touches.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES

from triquad_map.compiled.field.morton import encode
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.rows import with_room
from triquad_map.compiled.sparse.voxel_index import Index, VoxelIndex, make_row

_AXES = np.array(AXES)
PLANE_BITS = 40
"""Keys of blocks are Morton codes below this bit, and the number of the plane above it."""

_NO_BLOCK = -2  # key of row 0, which is found by no other
_MIN_CAPACITY = 256
_NEW_BLOCKS = 27  # at most, of a leaf: 9 on each plane
_NEW_ROWS = 48  # and as many vertices: 4 on each plane and level

Ints = NDArray[np.int32]
Codes = NDArray[np.int64]


class Vertices(NamedTuple):
    """The arrays of a tree that grow with it, as kernels take them."""

    blocks: Index  # rows of ``rows``, by the key of a block
    rows: Ints  # [blocks, vertices of a block] of the feature table; 0 for an absent vertex
    codes: Codes  # [rows] Morton code of each vertex
    owners: NDArray[np.uint8]  # [rows] its plane and level: ``1 + plane * H + h``


class Shape(NamedTuple):
    """The numbers of a tree that never change."""

    levels: int  # H
    limit: int  # blocks along the side of the cube
    starts: Codes  # [H] first vertex of each level within a block


@kernel(inline="always")
def block_key(plane: int, u: int, v: int) -> int:
    """Key of the block ``(u, v)`` on a plane."""
    key: int = encode(u, v) | (plane << PLANE_BITS)
    return key


@kernel()
def _enter(
    shape: Shape,
    vertices: Vertices,
    plane: int,
    h: int,
    u: int,
    v: int,
    row: int,
    count: int,
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
def _grow(
    shape: Shape,
    vertices: Vertices,
    leaves: Codes,
    start: int,
    blocks: int,
    rows: int,
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
def _restore(
    shape: Shape,
    vertices: Vertices,
    plane: int,
    h: int,
    coordinates: Codes,
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


class TriQuadtree:
    """Existing vertices of the three planes, and the rows of the feature table they own.

    Row 0 is reserved for absent vertices, and so is block 0, in which all are absent.
    """

    def __init__(self, settings: FieldSettings) -> None:
        self._settings = settings
        sides = [(1 << h) + 1 for h in range(settings.feature_levels)]  # vertices along a block
        starts = np.cumsum([0, *(side**2 for side in sides)])
        self.shape = Shape(settings.feature_levels, 1 << settings.levels[0], starts[:-1])
        self._rows = 1
        self._twin: TriQuadtree | None = None  # a copy for reading, until this tree grows
        self._blocks = VoxelIndex(_MIN_CAPACITY)
        self._blocks.arrays.row_keys[0] = _NO_BLOCK
        self._blocks.count = 1
        self.vertices = Vertices(
            self._blocks.arrays,
            np.zeros((_MIN_CAPACITY, starts[-1]), np.int32),
            np.zeros(_MIN_CAPACITY, np.int64),
            np.zeros(_MIN_CAPACITY, np.uint8),
        )

    def table(self, plane: int, h: int) -> tuple[Codes, Codes]:
        """Sorted Morton codes and rows of the vertices on a plane and the ``h``-th level."""
        owner = 1 + plane * self._settings.feature_levels + h
        rows = np.flatnonzero(self.vertices.owners[: self._rows] == owner)
        codes = self.vertices.codes[rows]
        order = np.argsort(codes)
        return codes[order], rows[order]

    def copy(self) -> "TriQuadtree":
        """A copy for reading, which does not change when this tree grows."""
        if self._twin is not None:
            return self._twin
        twin = TriQuadtree(self._settings)
        twin._rows = self._rows
        twin._blocks = self._blocks.copy()
        # Codes and owners of rows never change.
        twin.vertices = self.vertices._replace(
            blocks=twin._blocks.arrays, rows=self.vertices.rows[: self._blocks.count].copy()
        )
        self._twin = twin
        return twin

    def grow(self, leaves: Codes) -> int:
        """Make the nodes into which ``leaves`` project; returns how many rows are new.

        Leaves are int64 coordinates [N, 3] in ``[0, 2**depth)``.
        """
        if len(leaves):
            self._twin = None
        before = self._rows
        done = 0
        while done < len(leaves):
            done, self._blocks.count, self._rows = _grow(
                self.shape, self.vertices, leaves, done, self._blocks.count, self._rows
            )
            if done < len(leaves):
                self._make_room()
        return self._rows - before

    def restore(self, plane: int, h: int, codes: Codes) -> None:
        """Give the next rows to the vertices ``codes`` [V] of one level, in their order."""
        coordinates = morton.decode(codes, 2)
        self._twin = None
        done = 0
        while done < len(coordinates):
            done, self._blocks.count, self._rows = _restore(
                self.shape,
                self.vertices,
                plane,
                h,
                coordinates,
                done,
                self._blocks.count,
                self._rows,
            )
            if done < len(coordinates):
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
