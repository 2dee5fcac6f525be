"""A picture of a horizontal slice: distance and status, as a map answers them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from triquad_client import Grid, OfflineMap, Status
from triquad_format.records.seen_space import evidence_bounds

from triquad_tools.console.command import ToolError
from triquad_tools.mapfiles.source import Access, is_endpoint, open_map, read_whole
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

_MAX_DISTANCE_M = 3.0
SURFACE = "#a3341f"
BEHIND = "#d55e00"
DISTANCE_COLOURS = colormaps["viridis"].with_extremes(under=BEHIND)
"""The colours of distances from 0 up; those behind a surface stand out."""


@dataclass(frozen=True)
class SliceOptions:
    """The choice of a slice of a map."""

    height_m: float
    box_m: Sequence[float] | None  # west, south, east, north; None: all that a file has seen
    cell_m: float


def draw_slice(target: str, access: Access, options: SliceOptions, path: Path) -> None:
    """Draw a slice of the map in the file ``target``, or of a server at that endpoint.

    Raises:
        ToolError: no box is given for the map of a server, or a file has seen nothing.
        TriquadError: the server does not answer.
        FormatError: the file cannot be read as a map.
        OSError: ``target`` cannot be read, or ``path`` not be written.
    """
    west, south, east, north = options.box_m or _seen_box(target)
    height = options.height_m
    bounds = ((west, south, height), (east, north, height))
    with open_map(target, access) as opened:
        answer = opened.query_grid(bounds, options.cell_m, _MAX_DISTANCE_M)
        name = opened.name if isinstance(opened, OfflineMap) else access.map_name
    shape = answer.shape
    grid = PlanGrid(shape.corner[:2], shape.cell_m, rows=shape.counts[1], columns=shape.counts[0])
    plans = [
        Plan("Distance", partial(_draw_distance, answer)),
        Plan("Status", partial(_draw_status, answer)),
    ]
    title = f"{target}: map {name!r}, epoch {answer.epoch}, at z = {height:g} m"
    save_sheet(path, title, grid, plans=plans)


def _seen_box(target: str) -> list[float]:
    """Return west, south, east and north of what a file has seen."""
    if is_endpoint(target):
        raise ToolError("--slice of a server's map needs --box WEST SOUTH EAST NORTH")
    box = evidence_bounds(read_whole(Path(target)).record)
    if box is None:
        raise ToolError(f"{target}: no ray has shown anything of this map: nothing to slice")
    return [*box[0, :2].tolist(), *box[1, :2].tolist()]


def _draw_distance(answer: Grid, axes: Axes) -> None:
    """Draw distances where something was seen: elsewhere they only say how far the last wall is."""
    label = (
        f"m to the nearest surface, {_MAX_DISTANCE_M:g} or more\norange: behind it; grey: not seen"
    )
    seen = answer.status != Status.UNKNOWN
    distance_m = np.where(seen, answer.distance_m.astype(np.float64), np.nan)
    draw_values(axes, distance_m[:, :, 0].T, Scale(label, DISTANCE_COLOURS, 0.0, _MAX_DISTANCE_M))


def _draw_status(answer: Grid, axes: Axes) -> None:
    status = answer.status[:, :, 0].T
    layers = [
        Layer("FREE", FREE, status == Status.FREE),
        Layer("SURFACE", SURFACE, status == Status.SURFACE),
    ]
    draw_layers(axes, layers)
