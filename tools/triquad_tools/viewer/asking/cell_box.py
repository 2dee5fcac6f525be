"""Boxes of cells for which a map is queried."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_map.questions.grid import Grid

_SNAPS = 8  # to a side: a smaller move of the view moves no box


@dataclass(frozen=True)
class CellBox:
    """A box of cubic cells along the axes of the map frame."""

    corner: tuple[float, float, float]  # the least one, metres, map frame
    cell_m: float
    counts: tuple[int, int, int]  # along x, y and z

    @classmethod
    def around(cls, middle: Doubles, cell_m: float, counts: tuple[int, int, int]) -> "CellBox":
        """Return the box around a point [3], metres, map frame, to eighths of its longest side."""
        step_m = max(counts) * cell_m / _SNAPS
        x, y, z = np.round(middle / step_m) * step_m - 0.5 * cell_m * np.array(counts)
        return cls((float(x), float(y), float(z)), cell_m, counts)

    @property
    def size_m(self) -> Doubles:
        """The lengths [3] of its sides."""
        return np.asarray(self.cell_m * np.array(self.counts), np.float64)

    @property
    def middle(self) -> Doubles:
        """Its middle [3], metres, map frame."""
        return self.places(0.5 * np.array(self.counts))

    def places(self, cells: NDArray[np.number]) -> Doubles:
        """Return points [N, 3], metres, map frame, of cells [N, 3]: integers are least corners."""
        return np.asarray(self.corner + self.cell_m * cells, np.float64)

    def ask(self, queries: MapQueries, max_distance_m: float) -> Grid:
        """Return distance and status at the centres of all cells.

        Raises:
            TriquadError: the map does not answer.
        """
        # A hair less: else rounding may make one cell more.
        ends = self.places(np.array([[0.0, 0.0, 0.0], np.array(self.counts) - 0.01]))
        return queries.query_grid((ends[0].tolist(), ends[1].tolist()), self.cell_m, max_distance_m)
