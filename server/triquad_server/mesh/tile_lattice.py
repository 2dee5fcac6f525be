"""The lattices of mesh tiles, one for each level of detail, and how neighbours meet on them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs

from triquad_server.settings import MeshSettings

TileIndex = tuple[int, int, int]

_GROUP_CELLS = 8


@dataclass(frozen=True)
class TileLattice:
    """Where the cells and tiles of one level lie: at multiples of their sides."""

    cell_m: float
    cells: int  # along the side of a tile, the same on all levels
    reach_m: float  # centres of faces lie at most this far from voxels with seen surface
    group: int  # cells along the side of the groups that are searched first

    @property
    def tile_side_m(self) -> float:
        """Side of a tile."""
        return self.cell_m * self.cells

    @property
    def margin_m(self) -> float:
        """A change so far from a tile, or farther, does not concern it."""
        return self.cell_m + self.reach_m

    def meets(self, tiles: NDArray[np.integer], low: Doubles, high: Doubles) -> Bools:
        """Which of tiles [T, 3] meet the box between two corners [3]."""
        corners = tiles * self.tile_side_m
        return np.asarray(((corners <= high) & (corners + self.tile_side_m >= low)).all(axis=1))


def tile_lattice(settings: MeshSettings, level: int) -> TileLattice:
    """The lattice of a level, ``0 <= level < LEVELS``.

    A tile of level ``l`` covers ``2**l`` tiles of level 0 along each axis. Groups of cells are of
    the same size on all levels, so that no level searches farther around than level 0.
    """
    scale = 1 << level
    return TileLattice(
        settings.cell_m * scale,
        settings.tile_cells,
        settings.reach_m * scale,
        _GROUP_CELLS // scale,
    )


def tiles_meeting(low: Doubles, high: Doubles, margin_m: float, lattice: TileLattice) -> Longs:
    """Tiles [T, 3], each once, that come within ``margin_m`` of any of N boxes.

    ``low`` and ``high`` [N, 3] are the boxes' corners, metres, map frame.
    """
    first = np.floor((low - margin_m) / lattice.tile_side_m).astype(np.int64)
    last = np.floor((high + margin_m) / lattice.tile_side_m).astype(np.int64)
    tiles = [np.zeros((0, 3), np.int64)]
    for offset in np.ndindex(*((last - first).max(axis=0, initial=0) + 1)):
        tile = first + offset
        tiles.append(tile[(tile <= last).all(axis=1)])
    return _each_once(np.concatenate(tiles))


def _each_once(cells: Longs) -> Longs:
    """The different ones of cells [N, 3], in order."""
    if len(cells) == 0:
        return cells
    low = cells.min(axis=0)
    x, y, z = (int(size) for size in cells.max(axis=0) - low + 1)
    if x * y * z >= 2**62:
        return np.asarray(np.unique(cells, axis=0))
    # By one number each: numpy holds Python's lock while it sorts rows.
    names = np.unique(((cells - low) * (y * z, z, 1)).sum(axis=1))
    each = np.stack([names // (y * z), names // z % y, names % z], axis=1) + low
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
        last = len(volume) - 1
        outer = points[((points == 0) | (points == last)).any(axis=1)]
        return cls(outer.astype(np.int16), volume[tuple(outer.T)])

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
