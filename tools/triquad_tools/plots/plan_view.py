"""A picture of what a map file holds: what was seen, when it last changed, and how well it fits."""

import numpy as np
from PIL import Image
from triquad_format.mapfile.reader import MapFile

from triquad_tools.mapfiles.seen_space import Columns, seen_columns, surface_columns
from triquad_tools.plots.change_ages import ages_panel
from triquad_tools.plots.colour_scale import HEIGHT, WHITE, ColourScale, rgb
from triquad_tools.plots.plan_grid import PlanGrid
from triquad_tools.plots.plan_sheet import Panel, Swatch, draw_sheet
from triquad_tools.plots.sample_errors import errors_panel

_FREE = "#dde3ea"
_LEAST_RANGE_M = 0.1


def plan_picture(title: str, file: MapFile) -> Image.Image:
    """Plans of a map's coverage, of its latest changes and of its errors."""
    record = file.record
    surface, seen = surface_columns(record), seen_columns(record)
    grid = PlanGrid.around(seen.middles, record.settings.leaf_m)
    panels = (
        _coverage(grid, surface, seen),
        ages_panel(grid, file.manifest, seen, surface),
        errors_panel(grid, record),
    )
    return draw_sheet([title], grid, panels)


def _coverage(grid: PlanGrid, surface: Columns, seen: Columns) -> Panel:
    low, high = np.quantile(surface.tops, [0.01, 0.99]) if len(surface.tops) else (0.0, 0.0)
    scale = ColourScale(
        "height of the topmost surface in m", HEIGHT, low, max(high, low + _LEAST_RANGE_M)
    )
    tops = grid.highest(surface.middles, surface.tops)
    picture = scale.colours(tops)
    picture[grid.marked(seen.middles) & np.isnan(tops)] = rgb(_FREE)
    swatches = (Swatch(_FREE, "only free space was seen"), Swatch(WHITE, "nothing was seen"))
    return Panel("Coverage", picture, scale, swatches)
