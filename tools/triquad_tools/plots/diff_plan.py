"""A picture of how two maps differ: how far surface moved, and what only one of them has."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from triquad_format.records.status import Status

from triquad_tools.mapfiles.diff import Comparison, Sighting
from triquad_tools.mapfiles.object_changes import Cluster, ObjectChanges
from triquad_tools.plots.plan import (
    ERRORS,
    FREE,
    Layer,
    PlanGrid,
    Scale,
    draw_layers,
    draw_values,
    sheet,
)

# From Okabe and Ito's colours, which all can distinguish.
APPEARED, VANISHED, NEWLY_SEEN, NO_LONGER_KNOWN = "#0072b2", "#d55e00", "#56b4e9", "#f0e442"
_LEAST_RANGE_CM = 5.0
_LINE_PT = 1.5
_BESIDE_M = 0.1  # outlines lie this far outside of what they surround


def draw_diff(title: str, comparison: Comparison, objects: ObjectChanges, path: Path) -> None:
    """Draw a plan of the movement, and one of what appeared or vanished as a whole.

    Raises:
        OSError: ``path`` cannot be written.
    """
    old, new = comparison.old, comparison.new
    points = np.concatenate([old.points, new.points])[:, :2]
    grid = PlanGrid.around(points, min(old.leaf_m, new.leaf_m))
    headings = ("How far the surface moved", "In only one of the maps")
    with sheet(path, title, grid, headings) as (movement, presence):
        _draw_movement(movement, grid, old)
        _draw_presence(presence, grid, comparison)
        for found, colour in ((objects.appeared, APPEARED), (objects.vanished, VANISHED)):
            for cluster in found:
                _draw_box(presence, cluster, colour)
        presence.set_xlabel("x in m\noutlined: what appeared or vanished as a whole")


def _draw_movement(axes: Axes, grid: PlanGrid, old: Sighting) -> None:
    near = old.status == Status.SURFACE
    moved_cm = 100 * np.abs(old.sdf[near]).astype(np.float64)
    cells = grid.statistic(old.points[near], moved_cm, "mean")
    high = float(np.nanquantile(cells, 0.99)) if len(moved_cm) else 0.0
    label = "movement in cm, mean over the height"
    scale = Scale(label, ERRORS, low=0.0, high=max(np.ceil(high), _LEAST_RANGE_CM))
    draw_values(axes, cells, scale)


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
    draw_layers(axes, [Layer(*layer[:2], grid.marked(layer[2])) for layer in layers])


def _draw_box(axes: Axes, cluster: Cluster, colour: str) -> None:
    """Outline a cluster, a little outside of it."""
    x, y, _ = np.array(cluster.low_m) - _BESIDE_M
    width, depth, _ = cluster.size_m + 2 * _BESIDE_M
    axes.add_patch(
        Rectangle((x, y), width, depth, fill=False, edgecolor=colour, linewidth=_LINE_PT)
    )
