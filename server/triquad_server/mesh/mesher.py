"""Mesh tiles: their lattices, how neighbours meet on them, and marching cubes there.

Lattice points are multiples of the cell, whatever the tile, so neighbouring tiles share the
points of their common face and meet without seams, also where they were meshed at different
times: the later one takes over the values of the earlier one there. Only faces where the evidence
saw a surface are kept: elsewhere the field has zeros that no ray taught it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints, Longs
from triquad_format.records.cells import cells_of_boxes
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import STEPS, TileSurface
from triquad_map.compiled.kernel import kernel
from triquad_map.composition.composed_view import ComposedView
from triquad_map.filling import FilledVoxels, on_filled
from triquad_map.seen_faces import are_seen

from triquad_server.mesh.holes import cells_beside, filled_in_box
from triquad_server.mesh.marching_cubes import Crossings, centroids
from triquad_server.settings import MeshSettings

TileIndex = tuple[int, int, int]

_GROUP_CELLS = 8


@dataclass(frozen=True)
class TileLattice:
    """Where the cells and tiles of one level lie: at multiples of their sides."""

    cell_m: float
    cells: int  # along the side of a tile, the same on all levels
    reach_m: float  # centres of faces lie at most this far from voxels with seen surface
    group: int  # cells along the side of the groups in whose order faces come

    @property
    def tile_side_m(self) -> float:
        """Side of a tile."""
        return self.cell_m * self.cells

    @property
    def margin_m(self) -> float:
        """A change so far from a tile, or farther, does not concern it."""
        return self.cell_m + self.reach_m

    def meets(self, tiles: NDArray[np.integer], low: Doubles, high: Doubles) -> Bools:
        """Which [T] of tiles [T, 3] meet the box between two corners [3], metres, map frame."""
        corners = tiles * self.tile_side_m
        return np.asarray(((corners <= high) & (corners + self.tile_side_m >= low)).all(axis=1))

    def tiles_meeting(self, low: Doubles, high: Doubles, margin_m: float = 0.0) -> Longs:
        """Tiles [T, 3], each once, that come within ``margin_m`` of any of N boxes.

        ``low`` and ``high`` [N, 3] are the boxes' corners, metres, map frame.
        """
        boxes = _each_once(_tile_boxes(low, high, margin_m, self.tile_side_m))
        return _each_once(cells_of_boxes(boxes[:, :3], boxes[:, 3:])[0])


@kernel()
def _tile_boxes(low: Doubles, high: Doubles, margin_m: float, side_m: float) -> Longs:
    """The first and last tiles [B, 6] of boxes [N, 3]; once, where boxes in a row have the same."""
    boxes = np.empty((len(low), 6), np.int64)
    count = 0
    for i in range(len(low)):
        for axis in range(3):
            boxes[count, axis] = np.floor((low[i, axis] - margin_m) / side_m)
            boxes[count, 3 + axis] = np.floor((high[i, axis] + margin_m) / side_m)
        is_new = count == 0
        for k in range(6):
            is_new = is_new or boxes[count, k] != boxes[count - 1, k]
        count += int(is_new)
    return boxes[:count]


def tile_lattice(settings: MeshSettings, level: int) -> TileLattice:
    """The lattice of a level, ``0 <= level < LEVELS``.

    A tile of level ``l`` covers ``2**l`` tiles of level 0 along each axis. Groups of cells are of
    the same size on all levels, so that no level searches farther around than level 0.
    """
    scale = 1 << level
    return TileLattice(
        cell_m=settings.cell_m * scale,
        cells=settings.tile_cells,
        reach_m=settings.reach_m * scale,
        group=_GROUP_CELLS // scale,
    )


def _each_once(rows: Longs) -> Longs:
    """The different ones of rows [N, D], in order."""
    if len(rows) == 0:
        return rows
    columns = [np.ascontiguousarray(column) for column in rows.T]
    lows = [int(column.min()) for column in columns]
    sizes = [int(column.max()) - low + 1 for column, low in zip(columns, lows, strict=True)]
    if math.prod(sizes) >= 2**62:
        return np.asarray(np.unique(rows, axis=0))
    # By one number each: numpy holds Python's lock while it sorts rows.
    names = np.zeros(len(rows), np.int64)
    for column, low, size in zip(columns, lows, sizes, strict=True):
        names = names * size + (column - low)
    each = np.stack(np.unravel_index(np.unique(names), sizes), axis=1) + lows
    return np.asarray(each, np.int64)


@dataclass(frozen=True)
class TileBorder:
    """Signed distances at lattice points of a tile's faces: what it was made of, so that others can
    meet it there."""

    points: NDArray[np.int16]  # [P, 3] lattice points of the tile
    values: Floats  # [P] metres

    @classmethod
    def of_tile(cls, points: Longs, volume: Floats) -> "TileBorder":
        """Those of a tile's lattice points [P, 3] that lie on its faces."""
        return cls(*_on_faces(points, volume))

    @classmethod
    def joined(cls, borders: Iterable["TileBorder"]) -> "TileBorder":
        """All points of several borders; where one occurs twice, both say the same."""
        parts = list(borders)
        return cls(
            np.concatenate([np.zeros((0, 3), np.int16), *(part.points for part in parts)]),
            np.concatenate([np.zeros(0, np.float32), *(part.values for part in parts)]),
        )

    def seen_from(self, offset: tuple[int, int, int], cells: int) -> "TileBorder":
        """The points that a neighbour shares, in its own lattice.

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


@kernel()
def _on_faces(points: Longs, volume: Floats) -> tuple[NDArray[np.int16], Floats]:
    """Those of a tile's lattice points [P, 3] that lie on its faces, and their values."""
    last = len(volume) - 1
    outer = np.empty((len(points), 3), np.int16)
    values = np.empty(len(points), np.float32)
    count = 0
    for point in points:
        x, y, z = point
        if min(x, y, z) == 0 or max(x, y, z) == last:
            outer[count, 0], outer[count, 1], outer[count, 2] = x, y, z
            values[count] = volume[x, y, z]
            count += 1
    return outer[:count].copy(), values[:count].copy()


def check_level(level: int) -> None:
    """Refuse a level of detail that there is not.

    Raises:
        RefusedError: there is no such level.
    """
    if not 0 <= level < LEVELS:
        raise RefusedError("bad_request", f"level = {level} is out of range: use 0 to {LEVELS - 1}")


@dataclass(frozen=True)
class TileMesh:
    """Triangles of one tile. Vertices are numbered in the order in which faces use them."""

    origin: Doubles  # [3] metres, map frame: the tile's minimum corner
    cell_m: float
    crossings: Crossings  # the mesh, in cells from the origin
    border: TileBorder  # what it was made of on its faces
    filled: Bools  # [F] which faces fill holes

    @property
    def vertices(self) -> Floats:
        """The vertices [V, 3], metres, relative to the origin."""
        return (self.crossings.places * self.cell_m).astype(np.float32)

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


def mesh_tile(
    source: ComposedView,
    tile: TileIndex,
    lattice: TileLattice,
    around: TileBorder | None = None,
    fill_m: float = 0.0,
) -> TileMesh:
    """The surface within one tile.

    Args:
        source: the map.
        tile: indices of the tile, which covers ``[tile, tile + 1) * tile_side_m``.
        lattice: that of its level.
        around: distances at some lattice points, which are used instead of the map's.
        fill_m: how far from seen surface it is continued into unknown space, metres.
    """
    first = np.asarray(tile, np.int64) * lattice.cells
    cells = _seen_cells(source, first, lattice)
    holes = FilledVoxels.joined([])
    if fill_m > 0:
        low = first.astype(np.float64) * lattice.cell_m - lattice.reach_m
        high = low + lattice.tile_side_m + 2 * lattice.reach_m
        holes = filled_in_box(source, low, high, fill_m)
        beside = cells_beside(holes, source.voxel_m, lattice.cell_m, lattice.reach_m) - first
        inside = ((beside >= 0) & (beside < lattice.cells)).all(axis=1)
        cells = _each_once(np.concatenate([cells, beside[inside]]))
    volume, points = _lattice_values(source, cells, first=first, lattice=lattice, around=around)
    found = Crossings(cells, volume)
    middles = centroids((found.places + first) * lattice.cell_m, found.faces)
    kept = are_seen(source, middles, lattice.cell_m, lattice.reach_m)
    filled = ~kept
    filled[filled] = on_filled(
        source, holes, middles[filled], reach_m=lattice.reach_m, fill_m=fill_m
    )
    kept |= filled
    found.keep(kept)
    return TileMesh(
        origin=(first * lattice.cell_m).astype(np.float64),
        cell_m=lattice.cell_m,
        crossings=found,
        border=TileBorder.of_tile(points, volume),
        filled=filled[kept],
    )


def _seen_cells(source: ComposedView, first: Longs, lattice: TileLattice) -> Longs:
    """Cells [C, 3] of the tile that may hold faces which are near enough to seen surface."""
    middles = (first[:, None] + np.arange(lattice.cells) + 0.5) * np.float64(lattice.cell_m)
    near = source.surface_in_grid(middles, lattice.cell_m / 2 + lattice.reach_m)
    return _by_group(np.flatnonzero(near), lattice.cells, lattice.group)


@kernel()
def _by_group(names: Longs, side: int, group: int) -> Longs:
    """The cells [C, 3] of a tile with these numbers [C], increasing: group by group."""
    groups = -(-side // group)
    starts = np.zeros(groups**3 + 1, np.int64)
    homes = np.empty(len(names), np.int64)
    for i in range(len(names)):
        x, y, z = names[i] // (side * side), names[i] // side % side, names[i] % side
        homes[i] = (x // group * groups + y // group) * groups + z // group
        starts[homes[i] + 1] += 1
    starts = np.cumsum(starts)
    cells = np.empty((len(names), 3), np.int64)
    for i in range(len(names)):
        at = starts[homes[i]]
        starts[homes[i]] += 1
        cells[at, 0] = names[i] // (side * side)
        cells[at, 1] = names[i] // side % side
        cells[at, 2] = names[i] % side
    return cells


@kernel()
def _enter(values: Floats, points: Longs, volume: Floats) -> None:
    """Put values [P] at lattice points [P, 3] into the volume."""
    for i in range(len(points)):
        volume[points[i, 0], points[i, 1], points[i, 2]] = values[i]


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
    axes = (first[:, None] + np.arange(lattice.cells + 1)) * np.float64(lattice.cell_m)
    _enter(source.distances_in_grid(axes, asked), asked, volume)
    return volume, points
