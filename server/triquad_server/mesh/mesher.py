"""Meshes of tiles: marching cubes on a fixed lattice of the map frame.

Lattice points are multiples of the cell, whatever the tile, so neighbouring tiles share the
points of their common face and meet without seams, also where they were meshed at different
times: the later one takes over the values of the earlier one there. Only faces where the evidence
saw a surface are kept: elsewhere the field has zeros that no ray taught it.
"""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.status import Status
from triquad_format.wire.tile_codec import STEPS, TileSurface
from triquad_map.compiled.kernel import kernel
from triquad_map.composition.composed_view import ComposedView

from triquad_server.epochs import Epoch
from triquad_server.mesh.marching_cubes import Crossings
from triquad_server.mesh.tile_lattice import TileBorder, TileIndex, TileLattice, tiles_meeting


@dataclass(frozen=True)
class TileMesh:
    """Triangles of one tile. Vertices are numbered in the order in which faces use them."""

    origin: Doubles  # [3] metres, map frame: the tile's minimum corner
    cell_m: float
    points: NDArray[np.uint16]  # [V, 3] lower lattice points of the edges that hold the vertices
    axes: Bytes  # [V] along which the edges run
    fractions: Doubles  # [V] how far along them, 0 to 1
    faces: Ints  # [F, 3] counter-clockwise seen from free space
    border: TileBorder  # what it was made of on its faces

    @property
    def vertices(self) -> Floats:
        """The vertices [V, 3], metres, relative to the origin."""
        places = self.points.astype(np.float64)
        places[np.arange(len(places)), self.axes] += self.fractions
        return (places * self.cell_m).astype(np.float32)

    @property
    def surface(self) -> TileSurface:
        """The mesh as it travels."""
        steps = np.rint(self.fractions * STEPS).astype(np.uint8)
        return TileSurface(self.points, self.axes, steps, self.faces)


def surface_tiles(epoch: Epoch, lattice: TileLattice) -> Ints:
    """Tiles [T, 3], sorted, that meet a block with seen surface, or what is meshed around it."""
    settings = epoch.field_settings
    side_m = BLOCK_VOXELS * settings.leaf_m
    tiles: set[TileIndex] = set()
    for region in epoch.frozen_regions:
        corner = region.centre - settings.region_side_m / 2
        low = region.evidence.surface_cells() * side_m + corner
        around = tiles_meeting(low, low + side_m, lattice.reach_m, lattice)
        tiles.update((x, y, z) for x, y, z in around.tolist())
    return np.array(sorted(tiles), np.int32).reshape(-1, 3)


def mesh_tile(
    source: ComposedView, tile: TileIndex, lattice: TileLattice, around: TileBorder | None = None
) -> TileMesh:
    """The surface within one tile.

    Args:
        source: the map.
        tile: indices of the tile, which covers ``[tile, tile + 1) * tile_side_m``.
        lattice: that of its level.
        around: distances at some lattice points, which are used instead of the map's.
    """
    first = np.asarray(tile, np.int64) * lattice.cells
    seen = _seen_cells(source, first, lattice)
    volume, points = _lattice_values(source, seen, first, lattice, around)
    found = Crossings(seen, volume)
    places = found.points.astype(np.float64)
    places[np.arange(len(places)), found.axes] += found.fractions
    centroids = _centroids((places + first) * lattice.cell_m, found.faces)
    kept = source.status(centroids, lattice.reach_m) == Status.SURFACE
    used, faces = _renumbered(found.faces[kept], len(places))
    return TileMesh(
        (first * lattice.cell_m).astype(np.float64),
        lattice.cell_m,
        found.points[used],
        found.axes[used],
        found.fractions[used],
        faces,
        TileBorder.of_tile(points, volume),
    )


def _seen_cells(source: ComposedView, first: Longs, lattice: TileLattice) -> Longs:
    """Cells [C, 3] of the tile that may hold faces which are near enough to seen surface."""
    reach_m = lattice.cell_m / 2 + lattice.reach_m
    groups = _grid(-(-lattice.cells // lattice.group)) * lattice.group
    centres = _positions(groups, lattice.group / 2, first, lattice.cell_m)
    # A group is searched where any of its cells may be such.
    wide = lattice.cell_m * (lattice.group - 1) / 2 + reach_m
    groups = groups[source.status(centres, wide) == Status.SURFACE]
    cells = _cells_of(groups, lattice.group, lattice.cells)
    seen = source.status(_positions(cells, 0.5, first, lattice.cell_m), reach_m)
    return np.asarray(cells[seen == Status.SURFACE])


@kernel()
def _cells_of(groups: Longs, group_side: int, side: int) -> Longs:
    """Cells [C, 3] of groups, named by their least corners, of a tile of ``side`` cells."""
    cells = np.empty((len(groups) * group_side**3, 3), np.int64)
    count = 0
    for group in groups:
        for x in range(group[0], min(group[0] + group_side, side)):
            for y in range(group[1], min(group[1] + group_side, side)):
                for z in range(group[2], min(group[2] + group_side, side)):
                    cells[count, 0], cells[count, 1], cells[count, 2] = x, y, z
                    count += 1
    return cells[:count]


@kernel()
def _positions(cells: Longs, offset: float, first: Longs, cell_m: float) -> Doubles:
    """Where cells [C, 3] of the tile are in the map frame, ``offset`` cells from their corners."""
    positions = np.empty(cells.shape)
    for i in range(len(cells)):
        for axis in range(3):
            positions[i, axis] = (first[axis] + cells[i, axis] + offset) * cell_m
    return positions


@kernel()
def _centroids(vertices: Doubles, faces: Ints) -> Doubles:
    centroids = np.empty((len(faces), 3))
    for i in range(len(faces)):
        a, b, c = vertices[faces[i, 0]], vertices[faces[i, 1]], vertices[faces[i, 2]]
        for axis in range(3):
            centroids[i, axis] = (a[axis] + b[axis] + c[axis]) / 3
    return centroids


@kernel()
def _renumbered(faces: Ints, vertices: int) -> tuple[Longs, Ints]:
    """The vertices that faces use, in the order in which they do, and the faces with these."""
    numbers = np.full(vertices, -1, np.int32)
    used = np.empty(vertices, np.int64)
    renumbered = np.empty(faces.shape, np.int32)
    count = 0
    for i in range(len(faces)):
        for corner in range(3):
            vertex = faces[i, corner]
            if numbers[vertex] < 0:
                numbers[vertex] = count
                used[count] = vertex
                count += 1
            renumbered[i, corner] = numbers[vertex]
    return used[:count], renumbered


@functools.lru_cache(maxsize=8)
def _grid(side: int) -> Longs:
    """Cells [side**3, 3] of a cube."""
    axes = [np.arange(side, dtype=np.int64)] * 3
    cells: Longs = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    return cells.reshape(-1, 3)


@kernel()
def _corners(seen: Longs, volume: Floats) -> Longs:
    """The lattice points [P, 3] at the corners of cells [C, 3]; they become NaN in ``volume``."""
    points = np.empty((8 * len(seen), 3), np.int64)
    count = 0
    for cell in seen:
        for corner in range(8):
            x, y, z = cell[0] + (corner >> 2), cell[1] + (corner >> 1 & 1), cell[2] + (corner & 1)
            if not np.isnan(volume[x, y, z]):
                volume[x, y, z] = np.nan
                points[count, 0], points[count, 1], points[count, 2] = x, y, z
                count += 1
    return points[:count]


def _lattice_values(
    source: ComposedView, seen: Longs, first: Longs, lattice: TileLattice, around: TileBorder | None
) -> tuple[Floats, Longs]:
    """Distances on the tile's lattice points [cells + 1] * 3, and the points [P, 3] at seen cells.

    Those of other points mean nothing.
    """
    volume = np.zeros((lattice.cells + 1,) * 3, np.float32)
    points = _corners(seen, volume)
    asked = points
    if around is not None:
        around.put(volume)
        asked = points[np.isnan(volume[tuple(points.T)])]
    volume[tuple(asked.T)] = source.distances(_positions(asked, 0.0, first, lattice.cell_m))
    return volume, points
