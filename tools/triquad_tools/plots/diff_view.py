"""A picture of how two maps differ: what moved, and what is there in only one of them."""

from collections.abc import Sequence

import numpy as np
from PIL import Image
from triquad_format.records.status import Status

from triquad_tools.mapfiles.diff import Comparison
from triquad_tools.plots.colour_scale import HEAT, WHITE, ColourScale, rgb
from triquad_tools.plots.plan_grid import PlanGrid
from triquad_tools.plots.plan_sheet import Panel, Swatch, draw_sheet

_SAME = "#c9ced4"
_NEWLY_SEEN, _NOT_SEEN, _ADDED, _GONE = "#a6cdea", "#f4cfa0", "#0a5fa8", "#d9480f"
_LEAST_RANGE_CM = 5.0


def diff_picture(titles: Sequence[str], comparison: Comparison) -> Image.Image:
    """A plan of the movement, and one of what is added, gone and newly seen."""
    old, new = comparison.old, comparison.new
    points = np.concatenate([old.points, new.points])[:, :2]
    grid = PlanGrid.around(points, min(old.leaf_m, new.leaf_m))
    return draw_sheet(titles, grid, [_movement(grid, comparison), _presence(grid, comparison)])


def _movement(grid: PlanGrid, comparison: Comparison) -> Panel:
    old = comparison.old
    near = old.status == Status.SURFACE
    moved_cm = 100 * np.abs(old.sdf[near]).astype(np.float64)
    cells = grid.mean(old.points[near], moved_cm)
    high = float(np.quantile(cells[np.isfinite(cells)], 0.99)) if len(moved_cm) else 0.0
    scale = ColourScale(
        "movement in cm, mean over the height", HEAT, 0.0, max(np.ceil(high), _LEAST_RANGE_CM)
    )
    return Panel("Moved from A to B", scale.colours(cells), scale)


def _presence(grid: PlanGrid, comparison: Comparison) -> Panel:
    old, new = comparison.old, comparison.new
    picture = np.full((grid.rows, grid.columns, 3), rgb(WHITE), np.uint8)
    # Later ones cover earlier ones: what only one map has seen says least.
    layers = (
        (_SAME, old.having(Status.SURFACE), "in both"),
        (_NEWLY_SEEN, new.having(Status.UNKNOWN), "newly seen: only B has been there"),
        (_NOT_SEEN, old.having(Status.UNKNOWN), "not seen: only A has been there"),
        (_ADDED, new.having(Status.FREE), "added: free space in A"),
        (_GONE, old.having(Status.FREE), "gone: free space in B"),
    )
    for colour, points, _ in layers:
        picture[grid.marked(points)] = rgb(colour)
    swatches = tuple(Swatch(colour, label) for colour, _, label in layers)
    return Panel("In only one of the maps", picture, swatches=swatches)
