"""A sheet with the picture of a mesh: title, legends, notes."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from triquad_format.mapfile.durable_file import replacing
from triquad_format.records.arrays import Bytes, Doubles

from triquad_tools.plots.camera import Camera, ParallelCamera
from triquad_tools.plots.render import BACKGROUND

WIDTH, HEIGHT = 1340, 740
"""Of the picture in the sheet, pixels."""

_SHEET = (1600, 900)
_LEFT, _TOP = 0, 90  # of the picture in the sheet
_DPI = 100
_TITLE_PT, _LETTERS_PT = 20, 16  # can be read in half the size, too
_BAR = (1356, 190, 30, 330)  # left, top, width, height
_ARROWS_MIDDLE = (1465, 765)
_ARROW_PIXELS = 95.0
_LETTER_PIXELS = 16.0
_NOTE_LINE = 28
_LONGEST = 128  # letters in a line
_FRAME = "#b0b4b8"
_INK = "#1a1a1a"


@dataclass(frozen=True)
class ColourBar:
    """A scale of colours, with an arrow at each end beyond which there are values."""

    label: str
    stops: Doubles  # [K, 3] sRGB, from low to high
    low: float
    high: float
    above: str = ""  # what is told of values beyond, if there are any
    below: str = ""
    beyond: str | None = None  # colour of values above, if it is none of the scale
    limit: float | None = None  # a value that is marked by a line


@dataclass(frozen=True)
class Heading:
    """What a sheet is about."""

    title: str
    summary: str = ""  # a line below it


@dataclass(frozen=True)
class Legend:
    """What a sheet says about its picture."""

    heading: Heading
    bar: ColourBar
    notes: Sequence[str] = ()  # lines below the picture, two at most
    camera: Camera | None = None  # if it is parallel, its scale is told
    named: Sequence[tuple[str, str]] = ()  # further colours, and what they stand for


def save_mesh_sheet(path: Path, picture: Bytes, legend: Legend) -> None:
    """Save a sheet around a picture ``[HEIGHT, WIDTH, 3]``.

    Raises:
        OSError: ``path`` cannot be written.
    """
    width, height = _SHEET
    with rc_context({"font.size": _LETTERS_PT, "text.color": _INK}):
        figure = Figure((width / _DPI, height / _DPI), _DPI, facecolor=tuple(BACKGROUND))
        figure.figimage(picture, _LEFT, height - _TOP - HEIGHT, origin="upper")
        _draw_frame(figure)
        _text(figure, (16, 38), legend.heading.title, fontsize=_TITLE_PT)
        _text(figure, (16, 74), legend.heading.summary)
        for line, note in enumerate(legend.notes):
            _text(figure, (16, _TOP + HEIGHT + _NOTE_LINE * (line + 1)), note)
        _draw_bar(figure, legend.bar)
        _draw_named(figure, legend.named)
        if isinstance(legend.camera, ParallelCamera):
            _draw_arrows(figure, legend.camera)
        packed = io.BytesIO()
        figure.savefig(packed, format="png", facecolor=figure.get_facecolor())
    with replacing(path) as stream:
        stream.write(packed.getvalue())


def _text(figure: Figure, at: tuple[float, float], text: str, **style: Any) -> None:
    """Text whose base line begins at a pixel from the sheet's upper left corner."""
    if len(text) > _LONGEST:  # such as of long paths
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    figure.text(at[0] / _SHEET[0], 1.0 - at[1] / _SHEET[1], text, **style)


def _box(left: float, top: float, width: float, height: float) -> tuple[float, float, float, float]:
    """A box of pixels as matplotlib has it: from below, by the size of the sheet."""
    wide, high = _SHEET
    return (left / wide, 1.0 - (top + height) / high, width / wide, height / high)


def _draw_frame(figure: Figure) -> None:
    """What is cut off by it goes on beyond."""
    left, low, width, height = _box(_LEFT, _TOP, WIDTH, HEIGHT)
    frame = Rectangle((left, low), width, height, fill=False, edgecolor=_FRAME, linewidth=1)
    figure.add_artist(frame)


def _draw_bar(figure: Figure, bar: ColourBar) -> None:
    left, top, _, height = _BAR
    axes = figure.add_axes(_box(*_BAR))
    colours: Colormap = LinearSegmentedColormap.from_list(
        "bar", [tuple(stop) for stop in bar.stops]
    )
    colours = colours.with_extremes(over=bar.beyond) if bar.beyond else colours
    mapped = ScalarMappable(Normalize(bar.low, bar.high), colours)
    extend = ("neither", "min", "max", "both")[bool(bar.below) + 2 * bool(bar.above)]
    drawn = figure.colorbar(mapped, cax=axes, extend=extend, extendfrac=0.06)
    if bar.limit is not None:
        drawn.add_lines([bar.limit], [_INK], [3.0])
    _text(figure, (left, top - 44), bar.label, linespacing=1.2, verticalalignment="bottom")
    _text(figure, (left, top - 16), bar.above)
    _text(figure, (left, top + height + 30), bar.below)


def _draw_named(figure: Figure, named: Sequence[tuple[str, str]]) -> None:
    if named:
        handles = [Patch(facecolor=c, edgecolor=_INK, label=label) for c, label in named]
        corner = ((_BAR[0] - 12) / _SHEET[0], 1.0 - (_BAR[1] + _BAR[3] + 14) / _SHEET[1])
        figure.legend(
            handles=handles, loc="upper left", bbox_to_anchor=corner, frameon=False,
            handlelength=1.2, borderpad=0.3,
        )  # fmt: skip


def _draw_arrows(figure: Figure, camera: ParallelCamera) -> None:
    """Arrows along the map's axes, all of one length: a scale for each direction."""
    per_m = HEIGHT / camera.height_m
    across = per_m * camera.axes[:2].T  # [3, 2] right and down of each axis, for a metre
    length_m = _round_length(_ARROW_PIXELS / np.linalg.norm(across, axis=1).max())
    axes = figure.add_axes(_box(0, 0, *_SHEET), frameon=False)
    axes.set(xlim=(0, _SHEET[0]), ylim=(_SHEET[1], 0), xticks=[], yticks=[])
    middle = np.array(_ARROWS_MIDDLE)
    for name, arrow in zip("xyz", length_m * across, strict=True):
        style = {"arrowstyle": "-|>", "color": _INK, "shrinkA": 0, "shrinkB": 0, "linewidth": 2}
        tip = middle + arrow
        axes.annotate("", (tip[0], tip[1]), (middle[0], middle[1]), arrowprops=style)
        at = tip + arrow * (_LETTER_PIXELS / max(float(np.linalg.norm(arrow)), 1.0))
        axes.text(at[0], at[1], name, ha="center", va="center")
    axes.text(
        middle[0], middle[1] + _ARROW_PIXELS, f"arrows: {length_m:g} m", ha="center", va="bottom"
    )


def _round_length(most_m: float) -> float:
    """The greatest of 1, 2, 3, 5, 10, 20, ... that is no more."""
    decade = 10.0 ** math.floor(math.log10(most_m))
    return float(decade * max(step for step in (1, 2, 3, 5) if step * decade <= most_m))
