"""A picture of a horizontal slice: distance and status, as a map answers them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from triquad_client import OfflineMap, Status
from triquad_format.records.seen_space import evidence_bounds

from triquad_tools.console.command import ToolError
from triquad_tools.mapfiles.source import Access, is_endpoint, open_map, read_whole
from triquad_tools.plots.plan import (
    FREE,
    Layer,
    PlanGrid,
    Scale,
    draw_layers,
    draw_values,
    sheet,
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
    seen = answer.status[:, :, 0].T
    label = (
        f"m to the nearest surface, {_MAX_DISTANCE_M:g} or more\norange: behind it; grey: not seen"
    )
    scale = Scale(label, DISTANCE_COLOURS, 0.0, _MAX_DISTANCE_M)
    # Elsewhere distances only say how far the last wall is.
    distance_m = np.where(seen == Status.UNKNOWN, np.nan, answer.distance_m[:, :, 0].T)
    title = f"{target}: map {name!r}, epoch {answer.epoch}, at z = {height:g} m"
    with sheet(path, title, grid, ["Distance", "Status"]) as (distances, statuses):
        draw_values(distances, distance_m.astype(np.float64), scale)
        kinds = (Status.FREE, FREE), (Status.SURFACE, SURFACE)
        draw_layers(statuses, [Layer(kind.name, colour, seen == kind) for kind, colour in kinds])


def _seen_box(target: str) -> list[float]:
    """Return west, south, east and north of what a file has seen."""
    if is_endpoint(target):
        raise ToolError("--slice of a server's map needs --box WEST SOUTH EAST NORTH")
    box = evidence_bounds(read_whole(Path(target)).record)
    if box is None:
        raise ToolError(f"{target}: no ray has shown anything of this map: nothing to slice")
    return [*box[0, :2].tolist(), *box[1, :2].tolist()]
