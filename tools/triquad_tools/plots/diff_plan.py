"""A picture of how two maps differ: how far surface moved, and what only one of them has.

Both are plans: seen from above, in square cells, with axes in metres and a legend each.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status

from triquad_tools.mapfiles.diff import Comparison, Sighting
from triquad_tools.mapfiles.object_changes import Cluster, ObjectChanges
from triquad_tools.plots.colours import (
    APPEARED,
    FREE,
    MOVEMENT,
    NEWLY_SEEN,
    NO_LONGER_KNOWN,
    UNKNOWN,
    VANISHED,
)

_MOST_CELLS = 1200  # along the longer side of a plan
_LEAST_CELLS = 40  # along each side
_LEAST_SIDE = 0.25  # the shorter side's share of the longer one
_WIDE = 2.0  # the plans of a map that is wider stand below each other
_LONGEST_IN, _LONGEST_ASIDE_IN = 11.0, 6.5  # longer side of a plan
_ROOM_IN = (2.3, 1.7)  # next to a plan for its scale, below it for its legend
_LETTERS_PT = 13  # can be read in half the size, too
_LEAST_RANGE_CM = 5.0
_LINE_PT = 1.5
_BESIDE_M = 0.1  # outlines lie this far outside of what they surround


@dataclass(frozen=True)
class PlanGrid:
    """Square cells over a rectangle of the map frame's XY plane."""

    low_m: Doubles  # [2] corner of smallest x and y
    cell_m: float
    rows: int
    columns: int

    @classmethod
    def around(cls, points: NDArray[np.floating], leaf_m: float) -> "PlanGrid":
        """Return the grid that holds points ``[N, 2]``, of cells of one leaf or 2, 4, 8, ..."""
        points = points if len(points) else np.zeros((1, 2))
        low, high = points.min(axis=0), points.max(axis=0)
        longest = math.ceil(float((high - low).max()) / leaf_m) + 1
        cell_m = leaf_m * 2.0 ** max(math.ceil(math.log2(longest / _MOST_CELLS)), 0)
        first = np.floor(low / cell_m).astype(np.int64)
        count = np.floor(high / cell_m).astype(np.int64) - first + 1
        wanted = np.maximum(count, max(math.ceil(_LEAST_SIDE * count.max()), _LEAST_CELLS))
        first -= (wanted - count) // 2
        return cls(first * cell_m, cell_m, rows=int(wanted[1]), columns=int(wanted[0]))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south and north."""
        (west, south), side = self.low_m.tolist(), self.cell_m
        return west, west + side * self.columns, south, south + side * self.rows

    def sums(self, points: Doubles, values: Doubles | None = None) -> Doubles:
        """Return how many points ``[N, 3]`` lie in each cell, or the sum of their values ``[N]``.

        ``[rows, columns]``, row 0 that of the smallest y.
        """
        west, east, south, north = self.extent
        bins, limits = (self.rows, self.columns), ((south, north), (west, east))
        found = np.histogram2d(points[:, 1], points[:, 0], bins, limits, weights=values)[0]
        return np.asarray(found, np.float64)


def draw_diff(title: str, comparison: Comparison, objects: ObjectChanges, path: Path) -> None:
    """Draw a plan of the movement, and one of what appeared or vanished as a whole.

    Raises:
        OSError: ``path`` cannot be written.
    """
    old, new = comparison.old, comparison.new
    points = np.concatenate([old.points, new.points])[:, :2]
    grid = PlanGrid.around(points, min(old.leaf_m, new.leaf_m))
    with _sheet(path, title, grid) as (movement, presence):
        _draw_movement(movement, grid, old)
        _draw_presence(presence, grid, comparison)
        for found, colour in ((objects.appeared, APPEARED), (objects.vanished, VANISHED)):
            for cluster in found:
                _draw_box(presence, cluster, colour)
        presence.set_xlabel("x in m\noutlined: what appeared or vanished as a whole")


@contextmanager
def _sheet(path: Path, title: str, grid: PlanGrid) -> Iterator[tuple[Axes, Axes]]:
    """Yield axes for two plans of a grid, and then save the picture.

    They are at each other's side, or below each other where the map is wide.
    """
    wide = grid.columns > _WIDE * grid.rows
    inches = (_LONGEST_IN if wide else _LONGEST_ASIDE_IN) / max(grid.columns, grid.rows)
    rows, columns = (2, 1) if wide else (1, 2)
    width = columns * (inches * grid.columns + _ROOM_IN[0])
    height = rows * (inches * grid.rows + _ROOM_IN[1])
    west, east, south, north = grid.extent
    with rc_context({"font.size": _LETTERS_PT}):
        figure = Figure((width, height), dpi=110, layout="constrained")
        figure.suptitle(title, x=0.01, ha="left", parse_math=False)
        movement, presence = figure.subplots(rows, columns, sharex=True, sharey=True)
        movement.set_title("How far the surface moved", loc="left")
        presence.set_title("In only one of the maps", loc="left")
        for axes in (movement, presence):
            axes.set(xlabel="x in m", ylabel="y in m", aspect="equal", facecolor=UNKNOWN)
            axes.set(xlim=(west, east), ylim=(south, north))
        yield movement, presence
        figure.savefig(path)


def _draw_movement(axes: Axes, grid: PlanGrid, old: Sighting) -> None:
    """Colour cells by how far surface in them moved; a scale ends in an arrow if some is beyond."""
    near = old.status == Status.SURFACE
    moved_cm = 100 * np.abs(old.sdf[near]).astype(np.float64)
    counts, sums = grid.sums(old.points[near]), grid.sums(old.points[near], moved_cm)
    cells = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
    greatest = float(np.nanquantile(cells, 0.99)) if len(moved_cm) else 0.0
    most = max(np.ceil(greatest), _LEAST_RANGE_CM)
    image = axes.imshow(
        cells, MOVEMENT, vmin=0.0, vmax=most, extent=grid.extent, origin="lower",
        interpolation="none",
    )  # fmt: skip
    axes.figure.colorbar(
        image, cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)),
        label="movement in cm, mean over the height",
        extend="max" if (cells > most).any() else "neither",
    )  # fmt: skip


def _draw_presence(axes: Axes, grid: PlanGrid, comparison: Comparison) -> None:
    old, new = comparison.old, comparison.new
    # Later ones cover earlier ones: what only one map has seen says least.
    layers = (
        ("in both", FREE, old.having(Status.SURFACE)),
        ("newly seen: only B has been there", NEWLY_SEEN, new.having(Status.UNKNOWN)),
        ("no longer known: only A has been there", NO_LONGER_KNOWN, old.having(Status.UNKNOWN)),
        ("appeared: free space in A", APPEARED, new.having(Status.FREE)),
        ("vanished: free space in B", VANISHED, old.having(Status.FREE)),
    )
    for _, colour, points in layers:
        cells = np.where(grid.sums(points) > 0, 0.0, np.nan)
        axes.imshow(
            cells, ListedColormap([colour]), extent=grid.extent, origin="lower",
            interpolation="none",
        )  # fmt: skip
    named = [*(layer[:2] for layer in layers), ("nothing was seen (UNKNOWN)", UNKNOWN)]
    handles = [Patch(facecolor=colour, edgecolor="black", label=label) for label, colour in named]
    axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.0, -0.15), frameon=False, ncols=2
    )


def _draw_box(axes: Axes, cluster: Cluster, colour: str) -> None:
    """Outline a cluster, a little outside of it."""
    x, y, _ = np.array(cluster.low_m) - _BESIDE_M
    width, depth, _ = cluster.size_m + 2 * _BESIDE_M
    axes.add_patch(
        Rectangle((x, y), width, depth, fill=False, edgecolor=colour, linewidth=_LINE_PT)
    )
