"""A picture of how two maps differ: how far surface moved, and what only one of them has.

Both are plans: seen from above, in square cells, with axes in metres and a legend each.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch, Rectangle
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status

from triquad_tools.mapfiles.diff import Cluster, Comparison, Sighting
from triquad_tools.plots.colours import (
    APPEARED,
    FREE,
    MOVEMENT,
    NEWLY_SEEN,
    NO_LONGER_KNOWN,
    UNKNOWN,
    VANISHED,
)

_MOST_CELLS = 1200  # along the longer side of a plan
_LEAST_CELLS = 40  # along each side
_LEAST_SIDE = 0.25  # the shorter side's share of the longer one
_WIDE = 2.0  # the plans of a map that is wider stand below each other
_LONGEST_IN, _LONGEST_ASIDE_IN = 11.0, 6.5  # longer side of a plan
_ROOM_IN = (2.3, 1.7)  # next to a plan for its scale, below it for its legend
_LETTERS_PT = 13  # can be read in half the size, too
_LEAST_RANGE_CM = 5.0
_LINE_PT = 1.5
_BESIDE_M = 0.1  # outlines lie this far outside of what they surround

Edges = tuple[Doubles, Doubles]
"""The edges along x, and those along y, between the cells of a plan, metres, map frame."""


def draw_diff(
    title: str, comparison: Comparison, objects: Mapping[str, Sequence[Cluster]], path: Path
) -> None:
    """Draw a plan of the movement, and one of what appeared or vanished as a whole.

    Raises:
        OSError: ``path`` cannot be written.
    """
    old, new = comparison.old, comparison.new
    edges = _edges(np.concatenate([old.points, new.points]), min(old.leaf_m, new.leaf_m))
    columns, rows = (len(along) - 1 for along in edges)
    is_wide = columns > _WIDE * rows
    plans, longest_in = ((2, 1), _LONGEST_IN) if is_wide else ((1, 2), _LONGEST_ASIDE_IN)
    cell_in = longest_in / max(columns, rows)
    width, height = cell_in * columns + _ROOM_IN[0], cell_in * rows + _ROOM_IN[1]
    with rc_context({"font.size": _LETTERS_PT}):
        figure = Figure((plans[1] * width, plans[0] * height), dpi=110, layout="constrained")
        figure.suptitle(title, x=0.01, ha="left", parse_math=False)
        movement, presence = figure.subplots(*plans, sharex=True, sharey=True)
        for axes in (movement, presence):
            axes.set(xlabel="x in m", ylabel="y in m", facecolor=UNKNOWN)
        _draw_movement(movement, edges, old)
        _draw_presence(presence, edges, comparison)
        for kind, colour in (("appeared", APPEARED), ("vanished", VANISHED)):
            for cluster in objects[kind]:
                x, y, _ = np.array(cluster.low_m) - _BESIDE_M
                width, depth, _ = cluster.size_m + 2 * _BESIDE_M
                outline = Rectangle((x, y), width, depth, fill=False, ec=colour, lw=_LINE_PT)
                presence.add_patch(outline)
        figure.savefig(path)


def _edges(points: Doubles, leaf_m: float) -> Edges:
    """Return edges of a plan of points ``[N, 3]``, of cells of one leaf, or of 2, 4, 8, ..."""
    places = points[:, :2] if len(points) else np.zeros((1, 2))
    low, high = places.min(axis=0), places.max(axis=0)
    longest = math.ceil(float((high - low).max()) / leaf_m) + 1
    cell_m = leaf_m * 2.0 ** max(math.ceil(math.log2(longest / _MOST_CELLS)), 0)
    first = np.floor(low / cell_m)
    count = np.floor(high / cell_m) - first + 1
    wanted = np.maximum(count, max(math.ceil(_LEAST_SIDE * count.max()), _LEAST_CELLS))
    first -= (wanted - count) // 2
    x, y = (cell_m * np.arange(at, at + cells + 1) for at, cells in zip(first, wanted, strict=True))
    return x, y


def _sums(edges: Edges, points: Doubles, values: Doubles | None = None) -> Doubles:
    """Return how many points ``[N, 3]`` lie in each cell, or the sum of their values ``[N]``.

    ``[rows, columns]``, row 0 that of the smallest y.
    """
    sums = np.histogram2d(points[:, 1], points[:, 0], bins=edges[::-1], weights=values)[0]
    return np.asarray(sums, np.float64)


def _draw_movement(axes: Axes, edges: Edges, old: Sighting) -> None:
    """Colour cells by how far surface in them moved; a scale ends in an arrow if some is beyond."""
    near = old.having(Status.SURFACE)
    moved_cm = 100 * np.abs(near.sdf).astype(np.float64)
    counts, sums = _sums(edges, near.points), _sums(edges, near.points, moved_cm)
    cells = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
    greatest = float(np.nanquantile(cells, 0.99)) if len(moved_cm) else 0.0
    most = max(np.ceil(greatest), _LEAST_RANGE_CM)
    image = _draw_cells(axes, edges, cells, MOVEMENT, most)
    axes.set_title("How far the surface moved", loc="left")
    axes.figure.colorbar(
        image, cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)),
        label="movement in cm, mean over the height",
        extend="max" if (cells > most).any() else "neither",
    )  # fmt: skip


def _draw_presence(axes: Axes, edges: Edges, comparison: Comparison) -> None:
    changed = comparison.changed
    # Later ones cover earlier ones: what only one map has seen says least.
    layers = (
        ("in both", FREE, comparison.old.having(Status.SURFACE)),
        ("newly seen: only B has been there", NEWLY_SEEN, changed["newly_seen"]),
        ("no longer known: only A has been there", NO_LONGER_KNOWN, changed["no_longer_known"]),
        ("appeared: free space in A", APPEARED, changed["appeared"]),
        ("vanished: free space in B", VANISHED, changed["vanished"]),
    )
    shown = np.full([len(along) - 1 for along in reversed(edges)], np.nan)
    for number, (_, _, found) in enumerate(layers):
        shown[_sums(edges, found.points) > 0] = number
    colours = ListedColormap([colour for _, colour, _ in layers])
    _draw_cells(axes, edges, shown, colours, len(layers) - 1)
    axes.set_title("In only one of the maps", loc="left")
    axes.set_xlabel("x in m\noutlined: what appeared or vanished as a whole")
    named = [*(layer[:2] for layer in layers), ("nothing was seen (UNKNOWN)", UNKNOWN)]
    axes.legend(
        handles=[Patch(facecolor=colour, edgecolor="black", label=text) for text, colour in named],
        loc="upper left", bbox_to_anchor=(0.0, -0.15), frameon=False, ncols=2,
    )  # fmt: skip


def _draw_cells(
    axes: Axes, edges: Edges, cells: Doubles, colours: Colormap, most: float
) -> AxesImage:
    """Colour cells ``[rows, columns]`` by their values from 0 to ``most``, but those of NaN."""
    (west, *_, east), (south, *_, north) = edges
    return axes.imshow(
        cells, colours, vmin=0.0, vmax=most, extent=(west, east, south, north), origin="lower",
        interpolation="none",
    )  # fmt: skip
