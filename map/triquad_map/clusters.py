"""Clusters of voxels: which lie together, and the boxes around them.

Voxels are cells of a lattice, [N, 3] integers, of any size and any number of them equal.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Longs


def rows_of(keys: Longs, wanted: Longs) -> Longs:
    """Return rows [N] of ``wanted`` [N] in increasing ``keys`` [K]; -1 for what is not there."""
    if len(keys) == 0:
        return np.full(len(wanted), -1, np.int64)
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[rows] == wanted, rows, -1)


_CELL_VOXELS = 2
"""A cluster is made of cells of this side, which touch: its voxels lie up to as far apart."""

_SIDES = (-1, 0, 1)
_HALF_THE_NEIGHBOURS = [
    step for step in itertools.product(_SIDES, _SIDES, _SIDES) if step > (0, 0, 0)
]


@dataclass(frozen=True)
class Boxes:
    """The boxes around clusters of voxels, in coordinates of their lattice."""

    low: Longs  # [K, 3]
    high: Longs  # [K, 3] the last voxel and one
    box: NDArray[np.intp]  # [N] of each voxel


def clusters(voxels: Longs, scale: int = 1) -> NDArray[np.intp]:
    """Return the cluster [N] of each of ``voxels`` [N, 3], numbered from 0.

    Voxels that are at most two apart along each axis, ``scale`` times, are in one cluster; those
    that are more than three apart are not, unless others lie between.
    """
    return connected(voxels // (scale * _CELL_VOXELS))


def tight_boxes(voxels: Longs, longest: int, scale: int = 1) -> Boxes:
    """Return the boxes around the :func:`clusters` of ``voxels`` [N, 3].

    One that would be longer than ``longest`` voxels, ``scale`` times, is cut into equal pieces.
    """
    cluster = clusters(voxels, scale)
    whole = _around(voxels, cluster)
    size = whole.high - whole.low
    pieces = -(-size // (scale * longest))
    piece = (voxels - whole.low[cluster]) * pieces[cluster] // size[cluster]
    piece[:, 0] += (np.cumsum(pieces[:, 0]) - pieces[:, 0])[cluster]  # no two clusters share any
    return _around(voxels, _CellSet(piece).number)


def connected(cells: Longs) -> NDArray[np.intp]:
    """Return the cluster [N] of each of ``cells`` [N, 3], from 0: those that touch share it.

    Cells touch at a corner, too.
    """
    known = _CellSet(cells)
    pairs = [known.neighbours(step) for step in _HALF_THE_NEIGHBOURS]
    one, other = np.concatenate(pairs, axis=1)
    label = np.arange(len(known.first))
    while True:
        # A cluster takes the least label of its neighbours; its members follow.
        least = np.minimum(label[one], label[other])
        new = label.copy()
        np.minimum.at(new, label[one], least)
        np.minimum.at(new, label[other], least)
        new = new[new]
        if (new == label).all():
            break
        label = new
    _, cluster = np.unique(label, return_inverse=True)
    return cluster.reshape(-1)[known.number]


def same_cells(cells: Longs) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return one row [K] for each different cell of ``cells`` [N, 3], and each's number [N]."""
    known = _CellSet(cells)
    return known.first, known.number


class _CellSet:
    """The different cells among some, found in two steps: the column, then the height in it.

    So the coordinates may be of any size: no number has to contain all three.
    """

    first: NDArray[np.intp]  # [K] a row of each different cell
    number: NDArray[np.intp]  # [N] of each cell

    def __init__(self, cells: Longs) -> None:
        low = cells.min(axis=0, initial=np.iinfo(np.int64).max)
        x, y, z = (cells - low + 1).T  # a margin, so that nothing has neighbours beyond the ends
        self._width, self._height = y.max(initial=0) + 2, z.max(initial=0) + 2
        self._columns, column = np.unique(x * self._width + y, return_inverse=True)
        keys = column.reshape(-1) * self._height + z
        self._keys, self.first, number = np.unique(keys, return_index=True, return_inverse=True)
        self.number = number.reshape(-1)

    def neighbours(self, step: tuple[int, int, int]) -> NDArray[np.intp]:
        """Return pairs [2, P] of numbers of cells, the second a ``step`` from the first."""
        x, y, z = step
        column = rows_of(self._columns, self._columns + x * self._width + y)
        beside = column[self._keys // self._height]
        wanted = beside * self._height + self._keys % self._height + z
        found = np.where(beside >= 0, rows_of(self._keys, wanted), -1)
        rows = np.flatnonzero(found >= 0)
        return np.stack([rows, found[rows]])


def _around(voxels: Longs, group: NDArray[np.intp]) -> Boxes:
    count = int(group.max(initial=-1)) + 1
    low = np.full((count, 3), np.iinfo(np.int64).max)
    high = np.full((count, 3), np.iinfo(np.int64).min)
    np.minimum.at(low, group, voxels)
    np.maximum.at(high, group, voxels + 1)
    return Boxes(low, high, group)
