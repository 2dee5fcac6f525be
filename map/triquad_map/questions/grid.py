"""Dense grids of distance and status: costmaps and slices."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats

from triquad_map.questions.distance import DistanceOptions, distances
from triquad_map.view import MapView


@dataclass(frozen=True)
class GridShape:
    """The places of the middles of a grid's cells."""

    corner: Doubles  # [3] the grid's least corner, metres, map frame
    cell_m: float
    counts: tuple[int, int, int]  # cells along x, y and z; one along z is a slice

    @property
    def cells(self) -> int:
        """The number of cells."""
        return self.counts[0] * self.counts[1] * self.counts[2]

    def middles(self) -> Doubles:
        """Return the middles [cells, 3], z running fastest."""
        axes = [np.arange(count) for count in self.counts]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(self.corner + (cells + 0.5) * self.cell_m, np.float64)


@dataclass(frozen=True)
class Grid:
    """A map at the middles of a grid's cells, of one epoch."""

    shape: GridShape
    distance_m: Floats  # [x, y, z] to the nearest surface, at most max_distance_m
    status: Bytes  # [x, y, z] Status
    epoch: int


def grid(view: MapView, shape: GridShape, max_distance_m: float) -> Grid:
    """Return distance, of at most ``max_distance_m``, and status at the middles of all cells."""
    answer = distances(view, shape.middles(), DistanceOptions(max_distance_m))
    return Grid(
        shape,
        distance_m=answer.distance_m.reshape(shape.counts),
        status=answer.status.reshape(shape.counts),
        epoch=view.epoch,
    )
