"""Cells of a lattice, named by integer coordinates."""

import numpy as np
from numpy.typing import NDArray

from triquad_format.records.arrays import Bools, Longs


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


class CellIndex:
    """Different cells, sorted once, among which others are found."""

    def __init__(self, cells: Longs) -> None:
        """Sort ``cells`` [K, 3], in two steps as :func:`same_cells` does."""
        self._low = cells.min(axis=0, initial=np.iinfo(np.int64).max)
        x, y, z = (cells - self._low).T
        self._width, self._height = y.max(initial=-1) + 1, z.max(initial=-1) + 1
        self._columns, column = np.unique(x * self._width + y, return_inverse=True)
        names = column.reshape(-1) * self._height + z
        self._order = np.argsort(names)
        self._names = names[self._order]

    def rows_of(self, wanted: Longs) -> NDArray[np.intp]:
        """Return the row [N] of each of ``wanted`` [N, 3] cells; -1 where it is none of them."""
        if len(self._names) == 0:
            return np.full(len(wanted), -1)
        x, y, z = (wanted - self._low).T
        column, is_column = _find(self._columns, x * self._width + y)
        place, is_known = _find(self._names, column * self._height + z)
        inside = (y >= 0) & (y < self._width) & (z >= 0) & (z < self._height)
        return np.where(inside & is_column & is_known, self._order[place], -1)


def _find(known: Longs, wanted: Longs) -> tuple[NDArray[np.intp], Bools]:
    """Return where each of ``wanted`` [N] is in increasing ``known`` [K], and which [N] are."""
    place = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
    return place, known[place] == wanted
