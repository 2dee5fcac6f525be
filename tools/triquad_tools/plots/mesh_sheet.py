"""A sheet with the picture of a mesh: title, scale, remarks."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from triquad_format.mapfile.durable_file import replacing

from triquad_tools.plots.mesh_view import BACKGROUND, HEIGHT, WIDTH, Picture
from triquad_tools.plots.plan import Scale, extend

_WIDE, _HIGH = 1600, 900  # pixels of the sheet
TOP = 90
"""Rows of the sheet above the picture, which is at its left."""

_BAR = (1362, 390, 30, 360)  # left, pixels below it, width, height


@dataclass(frozen=True)
class Legend:
    """The texts of a sheet about its picture."""

    title: str  # one line or two
    scale: Scale
    beyond: tuple[bool, bool]  # whether there are values below and above the scale
    notes: Sequence[str]  # parts of a line below the picture; empty ones are left out
    limit: float | None = None  # a value that is marked by a line in the scale
    named: Sequence[tuple[str, str]] = ()  # further colours, and what they stand for


def save_mesh_sheet(path: Path, picture: Picture, legend: Legend) -> None:
    """Save a sheet around a picture.

    Raises:
        OSError: ``path`` cannot be written.
    """
    with rc_context({"font.size": 15}):
        figure = Figure((_WIDE / 100, _HIGH / 100), 100, facecolor=tuple(BACKGROUND))
        place = (0.0, 1.0 - (TOP + HEIGHT) / _HIGH, WIDTH / _WIDE, HEIGHT / _HIGH)
        axes = figure.add_axes(place, xticks=[], yticks=[])
        axes.imshow(picture.pixels(), interpolation="none", aspect="auto")
        axes.spines[:].set_visible(False)
        axes.set_title(legend.title, loc="left", x=0.01, parse_math=False)
        below = [picture.view.description, "; ".join(filter(None, legend.notes))]
        axes.set_xlabel("\n".join(below), ha="left", x=0.01)
        left, low, width, height = _BAR
        bar_place = (left / _WIDE, low / _HIGH, width / _WIDE, height / _HIGH)
        scale = legend.scale
        bar = figure.colorbar(
            ScalarMappable(Normalize(scale.low, scale.high), scale.colours),
            cax=figure.add_axes(bar_place), extend=extend(*legend.beyond), label=scale.label,
        )  # fmt: skip
        if legend.limit is not None:
            bar.add_lines([legend.limit], ["black"], [3.0])
        handles = [Patch(facecolor=c, edgecolor="black", label=text) for c, text in legend.named]
        if handles:
            at = (bar_place[0], bar_place[1] - 0.02)
            figure.legend(handles=handles, loc="upper left", bbox_to_anchor=at, frameon=False)
        with replacing(path) as stream:
            figure.savefig(stream, format="png", facecolor=figure.get_facecolor())
