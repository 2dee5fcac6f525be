"""The lattices on which mesh tiles lie, on each level of detail, and the values at their borders.

Tiles lie at multiples of their sides. Lattice points are multiples of the cell, whatever the tile,
so neighbouring tiles share the points of their common face and meet without seams.
"""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.cells import cells_of_boxes, same_cells

TileIndex = tuple[int, int, int]


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
