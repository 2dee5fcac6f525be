"""Rows of numbers by Morton code, found with numpy alone."""

from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Longs

ScalarT = TypeVar("ScalarT", bound=np.generic)

ONE_CELL = 63
"""A shift that leaves nothing of a code."""


_SIDES: tuple[Literal["left", "right"], ...] = ("left", "right")


class FoundRows(NamedTuple, Generic[ScalarT]):
    """The rows of N codes."""

    rows: NDArray[ScalarT]  # [N, size] zeros where there is none
    there: Bools  # [N]


class CodedRows(Generic[ScalarT]):
    """Rows of equal size by code. Codes that are the same but for ``shift`` bits are one cell.

    Cells are added one after the other, at a cost that depends on what is new alone.
    """

    def __init__(self, size: int, dtype: type[ScalarT], shift: int = ONE_CELL) -> None:
        self._nothing: NDArray[ScalarT] = np.zeros(size, dtype)
        self._shift = shift
        self._cells: dict[int, tuple[Longs, NDArray[ScalarT]]] = {}

    def add(self, codes: Longs, rows: NDArray[Any]) -> None:
        """Add rows [N, size] of increasing ``codes`` [N]: all of the cells that they are in."""
        cells = np.unique(codes >> self._shift)
        starts, ends = (np.searchsorted(codes >> self._shift, cells, side) for side in _SIDES)
        rows = rows.astype(self._nothing.dtype, copy=False)
        for cell, start, end in zip(cells.tolist(), starts, ends, strict=True):
            self._cells[cell] = codes[start:end], rows[start:end]

    def find(self, codes: Longs) -> FoundRows[ScalarT]:
        """The rows of ``codes`` [N]."""
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
