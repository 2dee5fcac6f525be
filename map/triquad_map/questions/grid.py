"""Dense grids of distance and status: costmaps and slices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats
from triquad_format.records.status import Status, Statuses

from triquad_map.questions.answer import drawn_on
from triquad_map.questions.distance import distances
from triquad_map.view import MapView

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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


@dataclass(frozen=True, repr=False)
class Grid:
    """A map at the middles of a grid's cells, of one epoch.

    Attributes:
        shape: where they are: ``shape.middles()``, ``shape.counts`` of cells along x, y and z.
        distance_m: [x, y, z] metres to the nearest surface, at most ``max_distance_m``.
        status: [x, y, z] :class:`Status`.
    """

    shape: GridShape
    distance_m: Floats
    status: Bytes
    epoch: int

    def __post_init__(self) -> None:
        """Let statuses be told by their names."""
        object.__setattr__(self, "status", Statuses.of(self.status))

    def __repr__(self) -> str:
        cells = " x ".join(map(str, self.shape.counts))
        told = Statuses.of(self.status).counted()
        return f"Grid({cells} cells of {self.shape.cell_m:g} m: {told}; epoch {self.epoch})"

    def plot(self, layer: int = 0, axes: Axes | None = None) -> Axes:
        """Draw a level layer of the grid, as distances in metres; unknown cells stay empty.

        Args:
            layer: which one, the lowest is 0.
            axes: where to draw; ``None``: axes of a new figure.

        Raises:
            InvalidInputError: matplotlib is not installed.
            IndexError: the grid has no such layer.
        """
        drawn = drawn_on(axes)
        (x, y, z), cell_m = self.shape.corner, self.shape.cell_m
        sides = np.array(self.shape.counts[:2]) * cell_m
        known = np.where(self.status == Status.UNKNOWN, np.nan, self.distance_m)[:, :, layer]
        extent = (x, x + sides[0], y, y + sides[1])
        image = drawn.imshow(known.T, origin="lower", extent=extent, cmap="viridis")
        drawn.figure.colorbar(image, ax=drawn, label="distance to surface, m")
        height_m = z + (layer % self.shape.counts[2] + 0.5) * cell_m
        drawn.set(title=f"z = {height_m:g} m, epoch {self.epoch}")
        return drawn


def grid(view: MapView, shape: GridShape, max_distance_m: float) -> Grid:
    """Return distance, of at most ``max_distance_m``, and status at the middles of all cells."""
    answer = distances(view, shape.middles(), max_distance_m)
    return Grid(
        shape,
        distance_m=answer.distance_m.reshape(shape.counts),
        status=answer.status.reshape(shape.counts),
        epoch=view.epoch,
    )
