"""A picture of a horizontal slice: distance and status, as a served map answers them."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from triquad_client import Grid, Status, TriquadError, connect

from triquad_tools.plots.colour_scale import HEIGHT, ColourScale, rgb
from triquad_tools.plots.plan_grid import PlanGrid
from triquad_tools.plots.plan_sheet import Panel, Swatch, draw_sheet

_MAX_DISTANCE_M = 3.0
_COLOURS = 64  # of the picture: a smaller file, and no difference to be seen
_STATUS = {
    Status.UNKNOWN: Swatch("#7d8794", "UNKNOWN"),
    Status.FREE: Swatch("#f4f1e8", "FREE"),
    Status.SURFACE: Swatch("#a3341f", "SURFACE"),
}
_BEHIND = "#c14a2e"


def slice_picture(title: str, answer: Grid) -> Image.Image:
    """The lowest layer of a grid: its distances beside its status."""
    shape = answer.shape
    grid = PlanGrid(shape.corner[:2], shape.cell_m, shape.counts[1], shape.counts[0])
    distance, status = _plan(answer.distance_m), _plan(answer.status)
    scale = ColourScale(
        f"distance to the nearest seen surface in m, {_MAX_DISTANCE_M:g} or more",
        HEIGHT,
        0.0,
        _MAX_DISTANCE_M,
    )
    distances = scale.colours(distance)
    distances[distance < 0] = rgb(_BEHIND)
    codes = np.zeros((*status.shape, 3), np.uint8)
    for value, swatch in _STATUS.items():
        codes[status == value] = rgb(swatch.colour)
    panels = (
        Panel("Distance", distances, scale, (Swatch(_BEHIND, "behind a surface, and near it"),)),
        Panel("Status", codes, swatches=tuple(_STATUS.values())),
    )
    return draw_sheet([title], grid, panels).quantize(_COLOURS)


def _plan(layers: np.ndarray) -> np.ndarray:
    """The lowest of layers [x, y, z] as rows and columns, row 0 that of the largest y."""
    return np.asarray(layers[:, ::-1, 0].T)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 the server failed."""
    options = _parser().parse_args(argv)
    (west, south, east, north), height = options.box, options.height
    try:
        with connect(options.connect, options.map) as client:
            bounds = ((west, south, height), (east, north, height))
            answer = client.query_grid(bounds, options.cell, _MAX_DISTANCE_M)
    except TriquadError as error:
        print(f"slice_view: {error}", file=sys.stderr)
        return 1
    title = f"Map '{options.map}' at z = {height:g} m, epoch {answer.epoch}"
    slice_picture(title, answer).save(options.out, optimize=True)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m triquad_tools.plots.slice_view", description=__doc__
    )
    add = parser.add_argument
    add("out", type=Path, metavar="OUT.png")
    add("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    add("--map", default="demo", metavar="NAME")
    add(
        "--box",
        type=float,
        nargs=4,
        default=(0.0, -12.0, 40.0, 12.0),
        metavar=("WEST", "SOUTH", "EAST", "NORTH"),
        help="metres, map frame",
    )
    add("--height", type=float, default=1.0, metavar="Z", help="metres (default: 1)")
    add("--cell", type=float, default=0.1, metavar="M", help="side of the cells (default: 0.1)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
