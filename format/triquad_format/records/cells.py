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


def cell_names(cells: Longs) -> Longs:
    """Return one number for each of cells [N, 3], whose coordinates are 0 to 2**21 - 1."""
    return np.asarray((cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2])
