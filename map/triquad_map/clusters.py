"""Clusters of voxels: which lie together, and the boxes around them.

Voxels are cells of a lattice, [N, 3] integers, of any size and any number of them equal.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Longs
from triquad_format.records.cells import CellIndex, same_cells

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
    return _around(voxels, same_cells(piece)[1])


def connected(cells: Longs) -> NDArray[np.intp]:
    """Return the cluster [N] of each of ``cells`` [N, 3], from 0: those that touch share it.

    Cells touch at a corner, too.
    """
    first, number = same_cells(cells)
    known = cells[first]
    index = CellIndex(known)
    touching = [index.rows_of(known + step) for step in _HALF_THE_NEIGHBOURS]
    one = np.concatenate([np.flatnonzero(rows >= 0) for rows in touching])
    other = np.concatenate([rows[rows >= 0] for rows in touching])
    label = np.arange(len(first))
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
    return cluster.reshape(-1)[number]


def _around(voxels: Longs, group: NDArray[np.intp]) -> Boxes:
    count = int(group.max(initial=-1)) + 1
    low = np.full((count, 3), np.iinfo(np.int64).max)
    high = np.full((count, 3), np.iinfo(np.int64).min)
    np.minimum.at(low, group, voxels)
    np.maximum.at(high, group, voxels + 1)
    return Boxes(low, high, group)
