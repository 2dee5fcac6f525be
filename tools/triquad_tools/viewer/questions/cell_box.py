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

    corner: tuple[float, ...]  # [3] the least one, metres, map frame
    cell_m: float
    counts: tuple[int, ...]  # along x, y and z

    @classmethod
    def around(cls, middle: Doubles, cell_m: float, counts: tuple[int, ...]) -> "CellBox":
        """Return the box around a point [3], metres, map frame, to eighths of its longest side."""
        step_m = max(counts) * cell_m / _SNAPS
        corner = np.round(middle / step_m) * step_m - 0.5 * cell_m * np.array(counts)
        return cls(tuple(corner.tolist()), cell_m, counts)

    @property
    def size_m(self) -> Doubles:
        """The lengths [3] of its sides."""
        return np.asarray(self.cell_m * np.array(self.counts), np.float64)

    def places(self, cells: NDArray[np.number]) -> Doubles:
        """Return points [..., 3], metres, map frame, of cells [..., 3]: integers are corners."""
        return np.asarray(self.corner + self.cell_m * cells, np.float64)

    def ask(self, queries: MapQueries, max_distance_m: float) -> Grid:
        """Return distance and status at the centres of all cells.

        Raises:
            TriquadError: the map does not answer.
        """
        # A hair less: else rounding may make one cell more.
        end = self.places(np.array(self.counts) - 0.01)
        bounds = (list(self.corner), end.tolist())
        return queries.query_grid(bounds, self.cell_m, max_distance_m)
