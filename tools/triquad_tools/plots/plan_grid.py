"""The cells of a plan: a map seen from above."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_CELLS = 1200
"""Along the longer side of a plan."""

_LEAST_CELLS = 40  # along each side
_LEAST_SIDE = 0.4  # the shorter side's share of the longer one: a legend must fit below

Window = tuple[slice, slice]


@dataclass(frozen=True)
class PlanGrid:
    """Square cells over a rectangle of the map frame's XY plane; row 0 is that of the largest y."""

    low_m: NDArray[np.float64]  # [2] corner of smallest x and y
    cell_m: float
    rows: int
    columns: int

    @classmethod
    def around(cls, points: NDArray[np.floating], leaf_m: float) -> "PlanGrid":
        """The grid that holds points ``[N, 2]``, of cells of one leaf or 2, 4, 8, ..."""
        points = points if len(points) else np.zeros((1, 2))
        low, high = points.min(axis=0), points.max(axis=0)
        longest = math.ceil(float((high - low).max()) / leaf_m) + 1
        cell_m = leaf_m * 2.0 ** max(math.ceil(math.log2(longest / MOST_CELLS)), 0)
        first = np.floor(low / cell_m).astype(np.int64)
        count = np.floor(high / cell_m).astype(np.int64) - first + 1
        wanted = np.maximum(count, max(math.ceil(_LEAST_SIDE * count.max()), _LEAST_CELLS))
        first -= (wanted - count) // 2
        return cls(first * cell_m, cell_m, int(wanted[1]), int(wanted[0]))

    @property
    def high_m(self) -> NDArray[np.float64]:
        """``[2]`` corner of largest x and y."""
        corner: NDArray[np.float64] = self.low_m + self.cell_m * np.array([self.columns, self.rows])
        return corner

    def window(self, low_m: NDArray[np.floating], high_m: NDArray[np.floating]) -> Window:
        """The cells with their middle between two corners [2], as an index into a plan."""
        first = np.ceil((low_m - self.low_m) / self.cell_m - 0.5).astype(np.int64)
        last = np.ceil((high_m - self.low_m) / self.cell_m - 0.5).astype(np.int64)
        left, below = np.clip(first, 0, [self.columns, self.rows]).tolist()
        right, above = np.clip(last, 0, [self.columns, self.rows]).tolist()
        return slice(self.rows - above, self.rows - below), slice(left, right)

    def marked(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """``[rows, columns]``: whether a cell holds any of the points ``[N, 2 or 3]``."""
        return self._counts(points) > 0

    def highest(
        self, points: NDArray[np.floating], values: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """``[rows, columns]``: greatest of the values ``[N]`` in a cell; NaN where none is."""
        greatest = np.full(self.rows * self.columns + 1, -np.inf)
        np.maximum.at(greatest, self._numbers(points), values)
        greatest[np.isneginf(greatest)] = np.nan
        return greatest[:-1].reshape(self.rows, self.columns)

    def mean(
        self, points: NDArray[np.floating], values: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """``[rows, columns]``: mean of the values ``[N]`` in a cell; NaN where none is."""
        sums = np.bincount(self._numbers(points), values, self.rows * self.columns + 1)
        with np.errstate(invalid="ignore"):
            return sums[:-1].reshape(self.rows, self.columns) / self._counts(points)

    def _counts(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        counts = np.bincount(self._numbers(points), minlength=self.rows * self.columns + 1)
        return counts[:-1].reshape(self.rows, self.columns)

    def _numbers(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        """Numbers ``[N]`` of the points' cells; what is outside gets that after the last."""
        column, row = np.floor((points[:, :2] - self.low_m) / self.cell_m).astype(np.int64).T
        row = self.rows - 1 - row
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return np.where(inside, row * self.columns + column, self.rows * self.columns)
