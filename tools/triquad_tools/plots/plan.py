"""Plans: maps seen from above, in square cells, with axes in metres and a legend each.

Space of which a map knows nothing is grey, which is in no scale of colours. Scales are those of
matplotlib whose lightness rises all along, so that nobody needs to see hues; what lies beyond a
scale has an arrow at its end.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.stats import binned_statistic_2d
from triquad_format.records.arrays import Bools, Doubles
from triquad_map.height_scale import HEIGHT_STOPS

UNKNOWN = "#bdbdbd"
FREE = "#f3f3f3"
HEIGHTS: Colormap = LinearSegmentedColormap.from_list("heights", HEIGHT_STOPS.tolist())
ERRORS: Colormap = colormaps["plasma_r"]

_MOST_CELLS = 1200  # along the longer side of a plan
_LEAST_CELLS = 40  # along each side
_LEAST_SIDE = 0.25  # the shorter side's share of the longer one
_WIDE = 2.0  # the plans of a map that is wider stand below each other
_LONGEST_IN, _LONGEST_ASIDE_IN = 11.0, 6.5  # longer side of a plan
_ROOM_IN = (2.3, 1.7)  # next to a plan for its scale, below it for its legend
_LETTERS_PT = 13  # can be read in half the size, too

Values = Doubles
"""One value for each cell ``[rows, columns]``, row 0 that of the smallest y; NaN where none is."""


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
    def high_m(self) -> Doubles:
        """``[2]`` corner of largest x and y."""
        corner: Doubles = self.low_m + self.cell_m * np.array([self.columns, self.rows])
        return corner

    def marked(self, points: NDArray[np.floating]) -> Bools:
        """Return ``[rows, columns]``: whether a cell holds any of the points ``[N, 2 or 3]``."""
        return self.statistic(points, np.zeros(len(points)), "count") > 0

    def statistic(
        self,
        points: NDArray[np.floating],
        values: NDArray[np.floating],
        kind: Literal["count", "max", "mean"],
    ) -> Values:
        """Return a statistic of the values ``[N]`` at points ``[N, 2 or 3]`` in each cell."""
        if not len(points):
            return np.full((self.rows, self.columns), 0.0 if kind == "count" else np.nan)
        x, y = points[:, 0], points[:, 1]
        limits = tuple(zip(self.low_m.tolist(), self.high_m.tolist(), strict=True))
        found = binned_statistic_2d(
            y, x, values, kind, bins=(self.rows, self.columns), range=limits[::-1]
        )
        return np.asarray(found.statistic, np.float64)


@dataclass(frozen=True)
class Scale:
    """Colours for values from ``low`` to ``high``."""

    label: str
    colours: Colormap
    low: float
    high: float


@dataclass(frozen=True)
class Layer:
    """Cells of one colour, and what it stands for."""

    label: str
    colour: str
    cells: Bools  # [rows, columns]


@contextmanager
def sheet(path: Path, title: str, grid: PlanGrid, headings: Sequence[str]) -> Iterator[list[Axes]]:
    """Yield axes of a grid for each of the plans with these headings, and then save the picture.

    They are at each other's side, or below each other where the map is wide.

    Raises:
        OSError: ``path`` cannot be written.
    """
    wide = grid.columns > _WIDE * grid.rows
    inches = (_LONGEST_IN if wide else _LONGEST_ASIDE_IN) / max(grid.columns, grid.rows)
    rows, columns = (len(headings), 1) if wide else (1, len(headings))
    width = columns * (inches * grid.columns + _ROOM_IN[0])
    height = rows * (inches * grid.rows + _ROOM_IN[1])
    with rc_context({"font.size": _LETTERS_PT}):
        figure = Figure((width, height), dpi=110, layout="constrained")
        figure.suptitle(title, x=0.01, ha="left", parse_math=False)
        places = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for heading, axes in zip(headings, places.flat, strict=True):
            axes.set_title(heading, loc="left")
            axes.set_facecolor(UNKNOWN)
            axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
            axes.set_xlim(grid.low_m[0], grid.high_m[0])
            axes.set_ylim(grid.low_m[1], grid.high_m[1])
        yield list(places.flat)
        figure.savefig(path)


def extend(below: bool, above: bool) -> Literal["neither", "min", "max", "both"]:
    """Return the ends of a scale that have an arrow, since there are values beyond."""
    return (("neither", "max"), ("min", "both"))[below][above]


def draw_values(axes: Axes, values: Values, scale: Scale) -> None:
    """Colour the cells that have a value, and show the scale."""
    known = values[np.isfinite(values)]
    ends = extend(bool((known < scale.low).any()), bool((known > scale.high).any()))
    image = _draw_cells(axes, values, cmap=scale.colours, vmin=scale.low, vmax=scale.high)
    aside = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
    axes.figure.colorbar(image, cax=aside, label=scale.label, extend=ends)


def draw_layers(axes: Axes, layers: Sequence[Layer]) -> None:
    """Colour cells, later layers over earlier ones, with a legend that has the unknown, too."""
    for layer in layers:
        cells = np.where(layer.cells, 0.0, np.nan)
        _draw_cells(axes, cells, cmap=ListedColormap([layer.colour]))
    named = [(layer.colour, layer.label) for layer in layers]
    named.append((UNKNOWN, "nothing was seen (UNKNOWN)"))
    handles = [Patch(facecolor=colour, edgecolor="black", label=label) for colour, label in named]
    axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.0, -0.15), frameon=False, ncols=2
    )


def _draw_cells(axes: Axes, values: Values, **colours: Any) -> AxesImage:
    extent = (*axes.get_xlim(), *axes.get_ylim())
    return axes.imshow(values, origin="lower", extent=extent, interpolation="none", **colours)
