"""Cells of a lattice, named by integer coordinates."""

import numpy as np
from numpy.typing import NDArray

from triquad_format.records.arrays import Longs


def cells_of_boxes(first: Longs, last: Longs) -> tuple[Longs, NDArray[np.intp]]:
    """Return all cells [C, 3] from ``first`` to ``last`` [N, 3] of boxes, and boxes' rows [C]."""
    cells, rows = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.intp)]
    for step in np.ndindex(*((last - first).max(axis=0, initial=0) + 1)):
        cell = first + step
        inside = np.flatnonzero((cell <= last).all(axis=1))
        cells.append(cell[inside])
        rows.append(inside)
    return np.concatenate(cells), np.concatenate(rows)


def same_cells(cells: Longs) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return one row [K] for each different cell of ``cells`` [N, 3], and each's number [N].

    Their coordinates may be of any size: first the columns are told apart, then the heights in
    them, so that no number has to contain all three.
    """
    x, y, z = (cells - cells.min(axis=0, initial=np.iinfo(np.int64).max)).T
    column = np.unique(x * (y.max(initial=0) + 1) + y, return_inverse=True)[1].reshape(-1)
    names = column * (z.max(initial=0) + 1) + z
    _, first, number = np.unique(names, return_index=True, return_inverse=True)
    return first, number.reshape(-1)


def rows_of(cells: Longs, wanted: Longs) -> NDArray[np.intp]:
    """Return rows [N] of ``wanted`` [N, 3] in different ``cells`` [K, 3]; -1 for others."""
    number = same_cells(np.concatenate([cells, wanted]))[1]
    rows = np.full(number.max(initial=-1) + 1, -1)
    rows[number[: len(cells)]] = np.arange(len(cells))
    return rows[number[len(cells) :]]
