"""Slices of a map: their places, queries and pictures."""

from dataclasses import dataclass

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats
from triquad_format.records.status import Status

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import DISTANCE_COLOURS
from triquad_tools.viewer.asking.cell_box import CellBox
from triquad_tools.viewer.page.page import Focus

_CELLS, _UPRIGHT_CELLS = 192, 96  # along the width, and along the height of an upright slice
_PIXELS, _DPI = 6, 100  # along a cell, so that the browser blurs no more than their borders
_LINE_PT, _SURFACE_PT, _LETTERS_PT = 1.2, 3.0, 14
_LEVELS = MaxNLocator(8, steps=[1, 2, 5, 10])  # no more lines, at round distances

HEIGHT_AXIS = 2


@dataclass(frozen=True)
class Slice:
    """The answers at the centres of one layer of cells, of one epoch.

    Columns run along the first of the two axes that the slice has, rows along the second.
    """

    distance_m: Floats  # [rows, columns]
    known: Bools  # [rows, columns] whether anything was seen there
    epoch: int


def slice_box(focus: Focus, axis: int, at_m: float) -> CellBox:
    """Return a layer of cells at some x, y or z (axis 0, 1 or 2), around the camera's target."""
    counts = [_CELLS, _CELLS, _CELLS if axis == HEIGHT_AXIS else _UPRIGHT_CELLS]
    counts[axis] = 1
    cell_m = focus.side_m / _CELLS
    box = CellBox.around(focus.middle, cell_m, (counts[0], counts[1], counts[2]))
    corner = list(box.corner)
    corner[axis] = at_m - 0.5 * cell_m
    return CellBox((corner[0], corner[1], corner[2]), cell_m, box.counts)


def slice_axes(axis: int) -> Doubles:
    """Return unit vectors [3, 3] as columns of a rotation: along rows, along columns, across."""
    across, up = np.delete(np.eye(3), axis, axis=0)
    return np.stack([across, up, np.cross(across, up)], axis=1)


def ask_slice(queries: MapQueries, box: CellBox, axis: int, max_distance_m: float) -> Slice:
    """Ask for all of a slice.

    Raises:
        TriquadError: the map does not answer.
    """
    answer = box.ask(queries, max_distance_m)
    distance_m, status = (
        values.take(0, axis=axis).T for values in (answer.distance_m, answer.status)
    )
    return Slice(distance_m, status != Status.UNKNOWN, answer.epoch)


def line_distances(max_distance_m: float) -> Doubles:
    """Return the round distances at which a slice has lines, from 0 up, metres."""
    levels = np.asarray(_LEVELS.tick_values(0.0, max_distance_m), np.float64)
    return levels[levels < max_distance_m]


def picture(answer: Slice, max_distance_m: float) -> Bytes:
    """Return colours [height, width, 3], the least row first, with lines at round distances.

    Lines end where nothing was seen; those of the surface itself are black.
    """
    rows, columns = answer.known.shape
    figure = Figure((columns * _PIXELS / _DPI, rows * _PIXELS / _DPI), _DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False)
    axes.set_axis_off()
    colours = DISTANCE_COLOURS(answer.distance_m.astype(np.float64) / max_distance_m)[..., :3]
    colours[~answer.known] = to_rgb(UNKNOWN)
    axes.imshow(colours, origin="lower", aspect="auto", interpolation="nearest")
    if answer.known.any():
        distance_m = np.ma.array(answer.distance_m, mask=~answer.known)
        levels = line_distances(max_distance_m)[1:]
        lines = axes.contour(distance_m, levels, colors="white", linewidths=_LINE_PT)
        axes.clabel(lines, fmt="%g m", fontsize=_LETTERS_PT)
        axes.contour(distance_m, [0.0], colors="black", linewidths=_SURFACE_PT)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    drawn = canvas.buffer_rgba()  # type: ignore[no-untyped-call]
    return np.asarray(drawn)[::-1, :, :3]
