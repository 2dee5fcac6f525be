"""Rows of numbers by Morton code, found with numpy alone."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Longs

ONE_CELL = 63
"""A shift that leaves nothing of a code."""


class FoundRows(NamedTuple):
    """The rows of N codes."""

    rows: NDArray[Any]  # [N, size] zeros where there is none
    there: Bools  # [N]


class CodedRows:
    """Rows of equal size by code. Codes that are the same but for ``shift`` bits are one cell.

    Cells are added one after the other, at a cost that depends on what is new alone.
    """

    def __init__(self, size: int, dtype: type[np.generic], shift: int = ONE_CELL) -> None:
        self._nothing: NDArray[Any] = np.zeros(size, dtype)
        self._shift = shift
        self._cells: dict[int, tuple[Longs, NDArray[Any]]] = {}

    def add(self, codes: Longs, rows: NDArray[Any]) -> None:
        """Add rows [N, size] of increasing ``codes`` [N]: all of the cells that they are in."""
        cells, starts = np.unique(codes >> self._shift, return_index=True)
        ends = [*starts[1:], len(codes)]
        rows = rows.astype(self._nothing.dtype, copy=False)
        for cell, start, end in zip(cells.tolist(), starts, ends, strict=False):
            self._cells[cell] = codes[start:end], rows[start:end]

    def find(self, codes: Longs) -> FoundRows:
        """Return the rows of ``codes`` [N]."""
        found = np.repeat(self._nothing[None], len(codes), axis=0)
        there = np.zeros(len(codes), np.bool_)
        cells, owners = np.unique(codes >> self._shift, return_inverse=True)
        for number, cell in enumerate(cells.tolist()):
            if cell in self._cells:
                mine = np.flatnonzero(owners.reshape(-1) == number)
                known, rows = self._cells[cell]
                at = np.minimum(np.searchsorted(known, codes[mine]), len(known) - 1)
                there[mine] = known[at] == codes[mine]
                found[mine] = np.where(there[mine, None], rows[at], self._nothing)
        return FoundRows(found, there)
