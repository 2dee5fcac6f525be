"""The three planar quadtrees of a region: which vertices exist, and which rows they own."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Longs
from triquad_format.records.field_settings import FieldSettings

from triquad_map.compiled.field.vertices import (
    NEW_BLOCKS,
    NEW_ROWS,
    Shape,
    Vertices,
    grow_vertices,
    restore_vertices,
)
from triquad_map.compiled.sparse.rows import with_room
from triquad_map.compiled.sparse.voxel_index import VoxelIndex

_NO_BLOCK = -2  # key of row 0, which is found by no other
_MIN_CAPACITY = 256


@dataclass(frozen=True)
class FrozenQuadtree:
    """The vertices of the three planes at one time, for any thread.

    Row 0 is reserved for absent vertices, and so is block 0, in which all are absent.
    """

    shape: Shape
    vertices: Vertices
    count: int  # rows of the feature table

    def table(self, plane: int, h: int) -> tuple[Longs, Longs]:
        """Sorted Morton codes and rows of the vertices on a plane and the ``h``-th level."""
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
        """The tree as it is now; the same object until it grows."""
        if self._frozen is None:
            # Codes and owners of rows never change.
            vertices = self.vertices._replace(
                blocks=self._blocks.freeze(), rows=self.vertices.rows[: self._blocks.count].copy()
            )
            self._frozen = FrozenQuadtree(self.shape, vertices, self._rows)
        return self._frozen

    def table(self, plane: int, h: int) -> tuple[Longs, Longs]:
        """Sorted Morton codes and rows of the vertices on a plane and the ``h``-th level."""
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
        if self._blocks.count + NEW_BLOCKS > self._blocks.capacity:
            self._blocks.grow()
            self.vertices = self.vertices._replace(
                blocks=self._blocks.arrays,
                rows=with_room(self.vertices.rows, self._blocks.capacity),
            )
        if self._rows + NEW_ROWS > len(self.vertices.codes):
            capacity = 2 * len(self.vertices.codes)
            self.vertices = self.vertices._replace(
                codes=with_room(self.vertices.codes, capacity),
                owners=with_room(self.vertices.owners, capacity),
            )
