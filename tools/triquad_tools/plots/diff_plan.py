"""A picture of how two maps differ: what moved, and what is there in only one of them."""

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from triquad_format.records.status import Status

from triquad_tools.mapfiles.diff import Comparison
from triquad_tools.plots.plan import (
    FREE,
    Layer,
    Plan,
    PlanGrid,
    Scale,
    draw_layers,
    draw_values,
    save_sheet,
)

# Of Okabe and Ito's colours, which all can tell apart.
ADDED, GONE, NEWLY_SEEN, NOT_SEEN = "#0072b2", "#d55e00", "#56b4e9", "#f0e442"
_LEAST_RANGE_CM = 5.0


def draw_diff(title: str, comparison: Comparison, path: Path) -> None:
    """Draw a plan of the movement, and one of what is added, gone and newly seen.

    Raises:
        OSError: ``path`` cannot be written.
    """
    old, new = comparison.old, comparison.new
    points = np.concatenate([old.points, new.points])[:, :2]
    grid = PlanGrid.around(points, min(old.leaf_m, new.leaf_m))
    plans = [
        Plan("Moved from A to B", partial(_draw_movement, grid, comparison)),
        Plan("In only one of the maps", partial(_draw_presence, grid, comparison)),
    ]
    save_sheet(path, title, grid, plans=plans)


def _draw_movement(grid: PlanGrid, comparison: Comparison, axes: Axes) -> None:
    old = comparison.old
    near = old.status == Status.SURFACE
    moved_cm = 100 * np.abs(old.sdf[near]).astype(np.float64)
    cells = grid.statistic(old.points[near], moved_cm, "mean")
    high = float(np.nanquantile(cells, 0.99)) if len(moved_cm) else 0.0
    label = "movement in cm, mean over the height"
    scale = Scale(label, "plasma_r", low=0.0, high=max(np.ceil(high), _LEAST_RANGE_CM))
    draw_values(axes, cells, scale)


def _draw_presence(grid: PlanGrid, comparison: Comparison, axes: Axes) -> None:
    old, new = comparison.old, comparison.new
    # Later ones cover earlier ones: what only one map has seen says least.
    layers = (
        ("in both", FREE, old.having(Status.SURFACE)),
        ("newly seen: only B has been there", NEWLY_SEEN, new.having(Status.UNKNOWN)),
        ("not seen: only A has been there", NOT_SEEN, old.having(Status.UNKNOWN)),
        ("added: free space in A", ADDED, new.having(Status.FREE)),
        ("gone: free space in B", GONE, old.having(Status.FREE)),
    )
    draw_layers(axes, [Layer(*layer[:2], grid.marked(layer[2])) for layer in layers])
