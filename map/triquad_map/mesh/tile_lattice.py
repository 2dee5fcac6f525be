"""The lattices on which mesh tiles lie, on each level of detail, and the values at their borders.

Tiles lie at multiples of their sides. Lattice points are multiples of the cell, whatever the tile,
so neighbouring tiles share the points of their common face and meet without seams.
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.cells import cells_of_boxes

from triquad_map.compiled.kernel import kernel

TileIndex = tuple[int, int, int]


@dataclass(frozen=True)
class TileLattice:
    """The places of the cells and tiles of one level of detail."""

    cell_m: float
    cells: int  # along the side of a tile, the same on all levels
    reach_m: float  # centres of faces lie at most this far from voxels with seen surface
    group: int = 8  # cells along the side of the groups in whose order faces come

    @property
    def tile_side_m(self) -> float:
        """Side of a tile."""
        return self.cell_m * self.cells

    @property
    def margin_m(self) -> float:
        """A change so far from a tile, or farther, does not concern it."""
        return self.cell_m + self.reach_m

    def at_level(self, level: int) -> "TileLattice":
        """Return the lattice ``level`` levels coarser: a tile has ``2**level`` of these an axis.

        Groups of cells keep their size, so that no level searches farther around than this one.
        """
        scale = 1 << level
        return dataclasses.replace(
            self,
            cell_m=self.cell_m * scale,
            reach_m=self.reach_m * scale,
            group=max(1, self.group // scale),
        )

    def meets(self, tiles: NDArray[np.integer], low: Doubles, high: Doubles) -> Bools:
        """Return which [T] of tiles [T, 3] meet the box between corners [3], metres, map frame."""
        corners = tiles * self.tile_side_m
        return np.asarray(((corners <= high) & (corners + self.tile_side_m >= low)).all(axis=1))

    def tiles_meeting(self, low: Doubles, high: Doubles, margin_m: float = 0.0) -> Longs:
        """Return tiles [T, 3], each once, that come within ``margin_m`` of any of N boxes.

        ``low`` and ``high`` [N, 3] are the boxes' corners, metres, map frame.
        """
        boxes = _each_once(_tile_boxes(low, high, margin_m, self.tile_side_m))
        return _each_once(cells_of_boxes(boxes[:, :3], boxes[:, 3:])[0])


def _each_once(rows: Longs) -> Longs:
    """Return the different rows among [N, D], in order."""
    if len(rows) == 0:
        return rows
    columns = [np.ascontiguousarray(column) for column in rows.T]
    lows = [int(column.min()) for column in columns]
    sizes = [int(column.max()) - low + 1 for column, low in zip(columns, lows, strict=True)]
    if math.prod(sizes) >= 2**62:
        return np.asarray(np.unique(rows, axis=0))
    # By one number each: numpy keeps Python's lock while it sorts rows.
    names = np.zeros(len(rows), np.int64)
    for column, low, size in zip(columns, lows, sizes, strict=True):
        names = names * size + (column - low)
    each = np.stack(np.unravel_index(np.unique(names), sizes), axis=1) + lows
    return np.asarray(each, np.int64)


@kernel()
def _tile_boxes(low: Doubles, high: Doubles, margin_m: float, side_m: float) -> Longs:
    """Return the first and last tiles [B, 6] of boxes [N, 3]; once for equal boxes in a row."""
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


@dataclass(frozen=True)
class TileBorder:
    """Signed distances at lattice points of a tile's faces, of which the tile was made."""

    points: NDArray[np.int16]  # [P, 3] lattice points of the tile
    values: Floats  # [P] metres

    @classmethod
    def of_tile(cls, points: Longs, volume: Floats) -> "TileBorder":
        """Return the lattice points [P, 3] of a tile that lie on its faces."""
        return cls(*_on_faces(points, volume))

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


@kernel()
def _on_faces(points: Longs, volume: Floats) -> tuple[NDArray[np.int16], Floats]:
    """Return the lattice points [P, 3] of a tile that lie on its faces, and their values."""
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
