"""A surface as triangles, and the meshes of tiles joined to one, without seams."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.cells import same_cells


@dataclass(frozen=True)
class Triangles:
    """Triangles, as of a :class:`Mesh`."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    filled: Bools | None = None

    def moved(self, by: Doubles) -> Triangles:
        """Return the triangles ``by`` [3] metres off."""
        return dataclasses.replace(self, vertices=self.vertices + by) if by.any() else self


WELD_M = 1e-4
"""Vertices closer than about this are one."""

_SHIFTS = np.array([(0.5, 0.5, 0.5), (0, 0.5, 0.5), (0.5, 0, 0.5), (0.5, 0.5, 0)])
"""Vertices that lie on a lattice edge may fall on two sides of a rounding boundary along it, and
along it only: a second round, shifted along that axis, brings them together."""


class TileJoin:
    """Joins tiles as they come: what concerns a single one is done before the next is there."""

    def __init__(
        self, tile_side_m: float, box: tuple[Doubles, Doubles], *, marked: bool = False
    ) -> None:
        """Keep the faces whose centroids lie in the ``box``, given by its corners [3], metres.

        Where tiles are ``marked``, the mesh marks which of its faces fill holes.
        """
        self._tile_side_m = tile_side_m
        self._box = box
        self._marked = marked
        self._count = 0  # of vertices so far
        self._vertices = [np.zeros((0, 3))]
        self._faces = [np.zeros((0, 3), np.int32)]
        self._shared = [np.zeros(0, np.int64)]
        self._filled = [np.zeros(0, np.bool_)]

    def add(self, tile: Triangles) -> None:
        """Add the mesh of a tile."""
        cut = _within(tile, self._box)
        self._vertices.append(cut.vertices)
        self._faces.append(cut.faces + np.int32(self._count))
        self._shared.append(_on_sides(cut.vertices, self._tile_side_m) + self._count)
        filled = np.zeros(len(cut.faces), np.bool_) if cut.filled is None else cut.filled
        self._filled.append(filled)
        self._count += len(cut.vertices)

    def mesh(self) -> Triangles:
        """Return all tiles so far as one mesh.

        It has one vertex where tiles had several, and no faces that this made degenerate. Faces are
        processed tile by tile: to touch fresh memory for all at once takes as long as the rest.
        """
        vertices, shared = np.concatenate(self._vertices), np.concatenate(self._shared)
        target = np.arange(len(vertices), dtype=np.int32)
        target[shared] = shared[_representatives(vertices[shared])]
        used = np.zeros(len(vertices), np.bool_)
        pieces = []
        for faces, filled in zip(self._faces, self._filled, strict=True):
            corners = target.take(faces)
            a, b, c = corners.T
            kept = (a != b) & (b != c) & (c != a)
            pieces.append((corners[kept], filled[kept]))
            used[pieces[-1][0]] = True
        number = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return Triangles(
            vertices[used],
            np.concatenate([number.take(corners) for corners, _ in pieces]),
            np.concatenate([filled for _, filled in pieces]) if self._marked else None,
        )


def joined(
    tiles: Iterable[Triangles], tile_side_m: float, box: tuple[Doubles, Doubles]
) -> Triangles:
    """Return the tiles' faces whose centroids lie in a box, by its corners [3], as one mesh."""
    join = TileJoin(tile_side_m, box)
    for tile in tiles:
        join.add(tile)
    return join.mesh()


def _within(tile: Triangles, box: tuple[Doubles, Doubles]) -> Triangles:
    """Return the faces of a tile whose centroids lie in a box; all of its vertices stay."""
    low, high = box
    if ((tile.vertices >= low) & (tile.vertices <= high)).all():
        return tile
    centroids = tile.vertices[tile.faces].mean(axis=1)
    inside = ((centroids >= low) & (centroids <= high)).all(axis=1)
    filled = None if tile.filled is None else tile.filled[inside]
    return dataclasses.replace(tile, faces=tile.faces[inside], filled=filled)


def _on_sides(vertices: Doubles, tile_side_m: float) -> Longs:
    """Return which vertices [V, 3], metres, lie on tiles' sides: others may have them, too."""
    steps = vertices / tile_side_m
    steps -= np.rint(steps)
    near = np.abs(steps, out=steps) < WELD_M / tile_side_m
    return np.flatnonzero(near[:, 0] | near[:, 1] | near[:, 2])


def _representatives(points: Doubles) -> NDArray[np.intp]:
    """Return the index of the point that stands for each point [N, 3]."""
    chosen = np.arange(len(points))
    for shift in _SHIFTS:
        left, at = np.unique(chosen, return_inverse=True)
        firsts, same = same_cells(np.floor(points[left] / WELD_M + shift).astype(np.int64))
        chosen = left[firsts[same]][at]
    return chosen
