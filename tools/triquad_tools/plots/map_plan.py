"""A picture of what a map file holds: what was seen, when it last changed, and how well it fits."""

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from triquad_format.mapfile.reader import MapFile

from triquad_tools.mapfiles.seen_space import Columns, seen_columns, surface_columns
from triquad_tools.plots.change_ages import ages_plan
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
from triquad_tools.plots.sample_errors import errors_plan

_LEAST_RANGE_M = 0.1


def draw_map(title: str, file: MapFile, path: Path) -> None:
    """Draw plans of a map's coverage, of its latest changes and of its errors.

    Raises:
        OSError: ``path`` cannot be written.
    """
    record = file.record
    surface, seen = surface_columns(record), seen_columns(record)
    grid = PlanGrid.around(seen.middles, record.settings.leaf_m)
    plans = [
        Plan("Coverage", partial(_draw_coverage, grid, surface, seen)),
        ages_plan(grid, file.manifest, seen),
        errors_plan(grid, record),
    ]
    save_sheet(path, title, grid, plans)


def _draw_coverage(grid: PlanGrid, surface: Columns, seen: Columns, axes: Axes) -> None:
    draw_layers(axes, [Layer("only free space was seen", FREE, grid.marked(seen.middles))])
    low, high = np.quantile(surface.tops, [0.01, 0.99]) if len(surface.tops) else (0.0, 0.0)
    label = "height of the topmost surface in m"
    scale = Scale(label, "viridis", float(low), float(max(high, low + _LEAST_RANGE_M)))
    draw_values(axes, grid.statistic(surface.middles, surface.tops, "max"), scale)
