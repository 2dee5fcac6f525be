"""The mesh of one tile: marching cubes near the surface that rays have seen.

Tiles lie at multiples of their sides. Lattice points are multiples of the cell, whatever the tile,
so neighbouring tiles share the points of their common face. They meet without seams also where they
were meshed at different times: the later one takes over the values of the earlier one at their
common points. Only faces where rays ended are kept, and, where that is asked for, those where the
surface goes on into unknown space, which are marked: elsewhere the field has zeros that no ray
taught it.
"""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints, Longs
from triquad_format.records.cells import cells_of_boxes, same_cells
from triquad_format.records.status import Status
from triquad_format.wire.tile_codec import STEPS, TileSurface

from triquad_map.compiled.kernel import kernel
from triquad_map.composition.composed_view import ComposedView
from triquad_map.mesh.filling import FilledVoxels, cells_around, filled_voxels, on_filled
from triquad_map.mesh.marching_cubes import Crossings, centroids
from triquad_map.triangles import Triangles

TileIndex = tuple[int, int, int]

_FINE = 0.5
"""Faces of larger cells, in voxels, stand for too much surface to end within a voxel: so they do
at cells of 0.4 m, by 0.6 points of F."""


@dataclass(frozen=True)
class TileLattice:
    """The places of the cells and tiles of one level of detail."""

    cell_m: float
    cells: int  # along the side of a tile, the same on all levels
    reach_m: float  # centres of faces lie at most this far from voxels with seen surface

    @property
    def tile_side_m(self) -> float:
        """Side of a tile."""
        return self.cell_m * self.cells

    @property
    def margin_m(self) -> float:
        """A change so far from a tile, or farther, does not concern it."""
        return self.cell_m + self.reach_m

    def at_level(self, level: int) -> "TileLattice":
        """Return the lattice ``level`` levels coarser: a tile has ``2**level`` of these an axis."""
        scale = 1 << level
        return dataclasses.replace(self, cell_m=self.cell_m * scale, reach_m=self.reach_m * scale)

    def meets(self, tiles: NDArray[np.integer], low: Doubles, high: Doubles) -> Bools:
        """Return which [T] of tiles [T, 3] meet the box between corners [3], metres, map frame."""
        corners = tiles * self.tile_side_m
        return np.asarray(((corners <= high) & (corners + self.tile_side_m >= low)).all(axis=1))

    def tiles_meeting(self, low: Doubles, high: Doubles, margin_m: float = 0.0) -> Longs:
        """Return tiles [T, 3], each once, that come within ``margin_m`` of any of N boxes.

        ``low`` and ``high`` [N, 3] are the boxes' corners, metres, map frame.
        """
        first = np.floor((low - margin_m) / self.tile_side_m).astype(np.int64)
        last = np.floor((high + margin_m) / self.tile_side_m).astype(np.int64)
        # Boxes that follow each other mostly meet the same tiles.
        differ = (np.diff(first, axis=0) | np.diff(last, axis=0)).any(axis=1)
        some = np.append(True, differ)[: len(first)]
        tiles = cells_of_boxes(first[some], last[some])[0]
        return tiles[same_cells(tiles)[0]]


@dataclass(frozen=True)
class TileBorder:
    """Signed distances at lattice points of a tile's faces, of which the tile was made."""

    points: NDArray[np.int16]  # [P, 3] lattice points of the tile
    values: Floats  # [P] metres

    @property
    def nbytes(self) -> int:
        """The bytes of memory that it takes."""
        return self.points.nbytes + self.values.nbytes

    @classmethod
    def of_tile(cls, points: Longs, volume: Floats) -> "TileBorder":
        """Return the lattice points [P, 3] of a tile that lie on its faces."""
        x, y, z = ((axis == 0) | (axis == len(volume) - 1) for axis in points.T)
        outer = points[x | y | z]
        return cls(outer.astype(np.int16), volume[tuple(outer.T)])

    @classmethod
    def joined(cls, borders: Iterable["TileBorder"]) -> "TileBorder":
        """Return all points of several borders; where one occurs twice, both say the same."""
        parts = list(borders)
        return cls(
            np.concatenate([np.zeros((0, 3), np.int16), *(part.points for part in parts)]),
            np.concatenate([np.zeros(0, np.float32), *(part.values for part in parts)]),
        )

    def seen_from(self, offset: tuple[int, int, int], cells: int) -> "TileBorder":
        """Return the points that a neighbour shares, in its own lattice.

        Args:
            offset: how many tiles this one lies from the neighbour, each -1, 0 or 1.
            cells: along the side of a tile.
        """
        points = self.points + (np.array(offset) * cells).astype(np.int16)
        shared = ((points >= 0) & (points <= cells)).all(axis=1)
        return TileBorder(points[shared], self.values[shared])

    def put(self, volume: Floats) -> None:
        """Enter the values where ``volume`` [S, S, S] waits for one (NaN)."""
        places = tuple(self.points.T)
        waits = np.isnan(volume[places])
        volume[tuple(self.points[waits].T)] = self.values[waits]


@dataclass(frozen=True)
class TileMesh:
    """Triangles of one tile. Vertices are numbered in the order in which faces use them."""

    first: Longs  # [3] the tile's minimum corner, in cells
    cell_m: float
    crossings: Crossings  # the mesh, in cells from the origin
    border: TileBorder  # what it was made of on its faces
    filled: Bools  # [F] which faces fill holes

    @property
    def faces(self) -> Ints:
        """Three vertices each [F, 3], counter-clockwise seen from free space."""
        return self.crossings.faces

    @property
    def surface(self) -> TileSurface:
        """The mesh as it travels."""
        found = self.crossings
        steps = np.rint(found.fractions * STEPS).astype(np.uint8)
        return TileSurface(found.points, found.axes, steps, faces=found.faces)

    @property
    def triangles(self) -> Triangles:
        """The mesh in the map frame, in double precision."""
        vertices = (self.crossings.places + self.first) * self.cell_m
        return Triangles(vertices, self.faces, self.filled)


def mesh_tile(
    view: ComposedView,
    tile: TileIndex,
    lattice: TileLattice,
    around: TileBorder | None = None,
    fill_m: float = 0.0,
) -> TileMesh:
    """Return the surface within one tile.

    Args:
        view: the map.
        tile: indices of the tile, which covers ``[tile, tile + 1) * tile_side_m``.
        lattice: that of its level.
        around: distances at some lattice points, which are used instead of the map's.
        fill_m: how far from seen surface it is continued into unknown space, metres.
    """
    first = np.asarray(tile, np.int64) * lattice.cells
    origin = first.astype(np.float64) * lattice.cell_m
    reach_m = lattice.reach_m
    filled = None
    if fill_m > 0:
        ends = origin - reach_m, origin + lattice.tile_side_m + reach_m
        filled = filled_voxels(view, *ends, fill_m)
    cells = _near_cells(view, filled, first, lattice)
    volume, points = _lattice_values(view, cells, first=first, lattice=lattice, around=around)
    found = Crossings(cells, volume)
    middles = centroids((found.places + first) * lattice.cell_m, found.faces)
    kept = _are_seen(view, middles, lattice)
    continued = np.zeros(len(kept), np.bool_)
    if filled is not None:
        continued[~kept] = on_filled(view, filled, middles[~kept], reach_m)
    kept |= continued
    found.keep(kept)
    return TileMesh(
        first=first,
        cell_m=lattice.cell_m,
        crossings=found,
        border=TileBorder.of_tile(points, volume),
        filled=continued[kept],
    )


def _are_seen(view: ComposedView, middles: Doubles, lattice: TileLattice) -> Bools:
    """Return whether faces [F] with ``middles`` [F, 3], metres, map frame, lie where rays ended."""
    if lattice.cell_m <= _FINE * view.voxel_m:
        return view.near_ends(middles, lattice.reach_m)
    seen: Bools = view.status(middles, lattice.reach_m) == Status.SURFACE
    return seen


def _near_cells(
    view: ComposedView, filled: FilledVoxels | None, first: Longs, lattice: TileLattice
) -> Longs:
    """Return cells [C, 3] of the tile that may have faces near seen or continued surface."""
    middles = (first[:, None] + np.arange(lattice.cells) + 0.5) * np.float64(lattice.cell_m)
    near = view.surface_in_grid(middles, lattice.cell_m / 2 + lattice.reach_m)
    if filled is not None:
        around = cells_around(filled, view.voxel_m, lattice.cell_m, lattice.reach_m) - first
        inside = ((around >= 0) & (around < lattice.cells)).all(axis=1)
        near[tuple(around[inside].T)] = True
    places = np.flatnonzero(near)  # in three dimensions at once, numpy takes ten times as long
    return np.stack(np.unravel_index(places, near.shape), axis=1)


@kernel()
def _enter(values: Floats, points: Longs, volume: Floats) -> None:
    """Put values [P] at lattice points [P, 3] into the volume."""
    for i in range(len(points)):
        volume[points[i, 0], points[i, 1], points[i, 2]] = values[i]


@kernel()
def _corners(seen: Longs, volume: Floats) -> Longs:
    """Return lattice points [P, 3] at corners of cells [C, 3]; they become NaN in ``volume``."""
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
    view: ComposedView, seen: Longs, first: Longs, lattice: TileLattice, around: TileBorder | None
) -> tuple[Floats, Longs]:
    """Return distances on the lattice points [cells + 1] * 3, and the points [P, 3] at seen cells.

    Those of other points mean nothing.
    """
    volume = np.zeros((lattice.cells + 1,) * 3, np.float32)
    points = _corners(seen, volume)
    asked = points
    if around is not None:
        around.put(volume)
        asked = points[np.isnan(volume[tuple(points.T)])]
    axes = (first[:, None] + np.arange(lattice.cells + 1)) * np.float64(lattice.cell_m)
    _enter(view.distances_in_grid(axes, asked), asked, volume)
    return volume, points
