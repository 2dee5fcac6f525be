"""Meshes of tiles: marching cubes on a fixed lattice of the map frame.

Lattice points are multiples of ``cell_m``, whatever the tile, so neighbouring tiles share the
points of their common face and meet without seams. Only faces where the evidence saw a surface are
kept: elsewhere the field has zeros that nobody taught it.
"""

from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes
from triquad_format.status import Status

from triquad_server.settings import MeshSettings

_GROUP = 8  # cells along the side of the groups that are looked at first


@dataclass(frozen=True)
class TileMesh:
    """Triangles of one tile."""

    origin: NDArray[np.float64]  # [3] metres, map frame: the tile's minimum corner
    vertices: NDArray[np.float32]  # [V, 3] metres, relative to the origin
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space
    changed: int  # epoch in which the tile last changed


class Distances(Protocol):
    """What the mesher asks of an epoch."""

    def distances(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Signed distances [N] at points [N, 3], metres."""

    def status(self, points: NDArray[np.float64], reach_m: float) -> NDArray[np.uint8]:
        """Status values [N] at points [N, 3]."""

    def changed(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> int:
        """Epoch of the last change between two corners [3]."""


def mesh_tile(source: Distances, tile: tuple[int, int, int], settings: MeshSettings) -> TileMesh:
    """The surface within one tile.

    Args:
        source: the map.
        tile: indices of the tile, which covers ``[tile, tile + 1) * tile_side_m``.
        settings: the lattice.
    """
    cells = settings.tile_cells
    first = np.asarray(tile, np.int64) * cells
    origin = (first * settings.cell_m).astype(np.float64)
    version = source.changed(origin, origin + settings.tile_side_m)
    seen = _seen_cells(source, first, settings)
    if len(seen) == 0:
        return _empty(origin, version)
    volume = _lattice_values(source, seen, first, settings)
    crossed, low, high = _crossed(seen, volume)
    if not crossed.any():
        return _empty(origin, version)
    box = tuple(slice(start, stop) for start, stop in zip(low, high, strict=True))
    # Face order: the distance falls towards the solid.
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        volume[box],
        0.0,
        mask=crossed[box],
        gradient_direction="descent",
    )
    vertices = (vertices + low) * settings.cell_m
    centroids = origin + _centroids(vertices, faces)
    kept = source.status(centroids, settings.reach_m) == Status.SURFACE
    return TileMesh(origin, *_without_others(vertices, faces, kept), version)


def _seen_cells(
    source: Distances,
    first: NDArray[np.int64],
    settings: MeshSettings,
) -> NDArray[np.int64]:
    """Cells [C, 3] of the tile that may hold faces which are near enough to seen surface."""
    reach_m = settings.cell_m / 2 + settings.reach_m
    groups = _grid(-(-settings.tile_cells // _GROUP)) * _GROUP
    centres = _positions(groups, _GROUP / 2, first, settings.cell_m)
    # A group is looked into where any of its cells may be such.
    wide = settings.cell_m * (_GROUP - 1) / 2 + reach_m
    groups = groups[source.status(centres, wide) == Status.SURFACE]
    cells = _cells_of(groups, settings.tile_cells)
    seen = source.status(_positions(cells, 0.5, first, settings.cell_m), reach_m)
    return np.asarray(cells[seen == Status.SURFACE])


@numba.njit(cache=True, nogil=True)
def _cells_of(groups: NDArray[np.int64], side: int) -> NDArray[np.int64]:
    """Cells [C, 3] of groups, named by their least corners, of a tile of ``side`` cells."""
    cells = np.empty((len(groups) * _GROUP**3, 3), np.int64)
    count = 0
    for group in groups:
        for x in range(group[0], min(group[0] + _GROUP, side)):
            for y in range(group[1], min(group[1] + _GROUP, side)):
                for z in range(group[2], min(group[2] + _GROUP, side)):
                    cells[count, 0], cells[count, 1], cells[count, 2] = x, y, z
                    count += 1
    return cells[:count]


@numba.njit(cache=True, nogil=True)
def _positions(
    cells: NDArray[np.int64], offset: float, first: NDArray[np.int64], cell_m: float
) -> NDArray[np.float64]:
    """Where cells [C, 3] of the tile are in the map frame, ``offset`` cells from their corners."""
    positions = np.empty(cells.shape)
    for i in range(len(cells)):
        for axis in range(3):
            positions[i, axis] = (first[axis] + cells[i, axis] + offset) * cell_m
    return positions


@numba.njit(cache=True, nogil=True, inline="always")
def _corner(cell: NDArray[np.int64], number: int) -> tuple[int, int, int]:
    """Lattice point at one of the 8 corners of a cell."""
    return cell[0] + (number >> 2), cell[1] + (number >> 1 & 1), cell[2] + (number & 1)


@numba.njit(cache=True, nogil=True)
def _centroids(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    centroids = np.empty((len(faces), 3))
    for i in range(len(faces)):
        a, b, c = vertices[faces[i, 0]], vertices[faces[i, 1]], vertices[faces[i, 2]]
        for axis in range(3):
            centroids[i, axis] = (a[axis] + b[axis] + c[axis]) / 3
    return centroids


@numba.njit(cache=True, nogil=True)
def _without_others(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], kept: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The faces that are kept, and the vertices that they use."""
    numbers = np.full(len(vertices), -1, np.int32)
    some_vertices = np.empty((len(vertices), 3), np.float32)
    some_faces = np.empty((len(faces), 3), np.int32)
    used = count = 0
    for i in range(len(faces)):
        if not kept[i]:
            continue
        for corner in range(3):
            vertex = faces[i, corner]
            if numbers[vertex] < 0:
                numbers[vertex] = used
                for axis in range(3):
                    some_vertices[used, axis] = vertices[vertex, axis]
                used += 1
            some_faces[count, corner] = numbers[vertex]
        count += 1
    return some_vertices[:used].copy(), some_faces[:count].copy()


def _grid(side: int) -> NDArray[np.int64]:
    """Cells [side**3, 3] of a cube."""
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)


@numba.njit(cache=True, nogil=True)
def _corners(seen: NDArray[np.int64], side: int) -> NDArray[np.int64]:
    """The different lattice points [P, 3] at the corners of cells [C, 3]."""
    needed = np.zeros((side, side, side), np.bool_)
    points = np.empty((8 * len(seen), 3), np.int64)
    count = 0
    for cell in seen:
        for corner in range(8):
            x, y, z = _corner(cell, corner)
            if not needed[x, y, z]:
                needed[x, y, z] = True
                points[count, 0], points[count, 1], points[count, 2] = x, y, z
                count += 1
    return points[:count]


def _lattice_values(
    source: Distances,
    seen: NDArray[np.int64],
    first: NDArray[np.int64],
    settings: MeshSettings,
) -> NDArray[np.float32]:
    """Distances on the tile's lattice points [cells + 1] * 3; far ones, at no seen cell, are 1."""
    side = settings.tile_cells + 1
    points = _corners(seen, side)
    volume = np.ones((side, side, side), np.float32)
    lattice = _positions(points, 0.0, first, settings.cell_m)
    volume[tuple(points.T)] = source.distances(lattice)
    return volume


@numba.njit(cache=True, nogil=True)
def _crossed(
    seen: NDArray[np.int64], volume: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Cells with corners on both sides of the surface, as skimage names them: by upper corner.

    Also the corners of the box of lattice points around them, the upper one exclusive.
    """
    mask = np.zeros(volume.shape, np.bool_)
    low, high = np.full(3, len(volume)), np.zeros(3, np.int64)
    for cell in seen:
        least, greatest = np.inf, -np.inf
        for corner in range(8):
            x, y, z = _corner(cell, corner)
            least, greatest = min(least, volume[x, y, z]), max(greatest, volume[x, y, z])
        if least <= 0 < greatest:
            mask[cell[0] + 1, cell[1] + 1, cell[2] + 1] = True
            for axis in range(3):
                low[axis] = min(low[axis], cell[axis])
                high[axis] = max(high[axis], cell[axis] + 2)
    return mask, low, high


def _empty(origin: NDArray[np.float64], version: int) -> TileMesh:
    return TileMesh(origin, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), version)
