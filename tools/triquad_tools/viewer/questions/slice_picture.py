"""Pictures of slices: distances in colours, with lines at round distances."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import DISTANCE_COLOURS

_PIXELS, _DPI = 6, 100  # along a cell, so that the browser blurs no more than their borders
_LINE_PT, _SURFACE_PT, _LETTERS_PT = 1.2, 3.0, 14
_LEVELS = MaxNLocator(8, steps=[1, 2, 5, 10])  # no more lines, at round distances


def line_distances(max_distance_m: float) -> Doubles:
    """Return the round distances at which a slice has lines, from 0 up, metres."""
    levels = np.asarray(_LEVELS.tick_values(0.0, max_distance_m), np.float64)
    return levels[levels < max_distance_m]


def slice_picture(distance_m: Floats, known: Bools, max_distance_m: float) -> Bytes:
    """Return colours [height, width, 3], the least row first, with lines at round distances.

    Lines end where nothing was seen; those of the surface itself are black.

    Args:
        distance_m: [rows, columns] at the centres of cells.
        known: [rows, columns] whether anything was seen there.
        max_distance_m: where the scale of colours ends.
    """
    rows, columns = known.shape
    figure = Figure((columns * _PIXELS / _DPI, rows * _PIXELS / _DPI), _DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False)
    axes.set_axis_off()
    colours = DISTANCE_COLOURS(distance_m.astype(np.float64) / max_distance_m)[..., :3]
    colours[~known] = to_rgb(UNKNOWN)
    axes.imshow(colours, origin="lower", aspect="auto", interpolation="nearest")
    if known.any():
        shown_m = np.ma.array(distance_m, mask=~known)
        levels = line_distances(max_distance_m)[1:]
        lines = axes.contour(shown_m, levels, colors="white", linewidths=_LINE_PT)
        axes.clabel(lines, fmt="%g m", fontsize=_LETTERS_PT)
        axes.contour(shown_m, [0.0], colors="black", linewidths=_SURFACE_PT)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    drawn = canvas.buffer_rgba()  # type: ignore[no-untyped-call]
    return np.asarray(drawn)[::-1, :, :3]
