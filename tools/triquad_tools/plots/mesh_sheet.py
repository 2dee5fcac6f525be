"""A sheet with the picture of a mesh: title, scales, remarks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from triquad_format.mapfile.durable_file import replacing
from triquad_format.records.arrays import Bytes

from triquad_tools.plots.mesh_view import BACKGROUND, HEIGHT, WIDTH, View
from triquad_tools.plots.plan import Scale, extend

_SHEET = (1600, 900)  # pixels
_TOP = 90  # of the picture
_BAR = (1362, 150, 30, 360)  # left, top, width, height
_LONGEST = 128  # letters in a line
_DIRECTIONS = ("+x", "+x +y", "+y", "-x +y", "-x", "-x -y", "-y", "+x -y")


@dataclass(frozen=True)
class Legend:
    """The texts of a sheet about its picture."""

    title: str  # one line or two
    scale: Scale
    beyond: tuple[bool, bool]  # whether there are values below and above the scale
    notes: Sequence[str]  # parts of a line below the picture; empty ones are left out
    limit: float | None = None  # a value that is marked by a line in the scale
    named: Sequence[tuple[str, str]] = ()  # further colours, and what they stand for


def save_mesh_sheet(path: Path, picture: Bytes, view: View, legend: Legend) -> None:
    """Save a sheet around a picture ``[HEIGHT, WIDTH, 3]``.

    Raises:
        OSError: ``path`` cannot be written.
    """
    wide, high = _SHEET
    with rc_context({"font.size": 15}):
        figure = Figure((wide / 100, high / 100), 100, facecolor=tuple(BACKGROUND))
        figure.figimage(picture, 0, high - _TOP - HEIGHT, origin="upper")
        frame = (0.0, 1.0 - (_TOP + HEIGHT) / high)
        figure.add_artist(Rectangle(frame, WIDTH / wide, HEIGHT / high, fill=False, ec="#b0b4b8"))
        for number, line in enumerate(legend.title.splitlines()):
            _write(figure, 16, 38 + 36 * number, line, (18, 15)[number > 0])
        _write(figure, 16, _TOP + HEIGHT + 30, _direction(view))
        _write(figure, 16, _TOP + HEIGHT + 58, "; ".join(filter(None, legend.notes)))
        left, low = _BAR[0] / wide, 1.0 - (_BAR[1] + _BAR[3]) / high
        axes = figure.add_axes((left, low, _BAR[2] / wide, _BAR[3] / high))
        scale = legend.scale
        mapped = ScalarMappable(Normalize(scale.low, scale.high), scale.colours)
        bar = figure.colorbar(mapped, cax=axes, extend=extend(*legend.beyond), label=scale.label)
        if legend.limit is not None:
            bar.add_lines([legend.limit], ["black"], [3.0])
        handles = [Patch(facecolor=c, edgecolor="black", label=text) for c, text in legend.named]
        if handles:
            at = (left, low - 0.02)
            figure.legend(handles=handles, loc="upper left", bbox_to_anchor=at, frameon=False)
        with replacing(path) as stream:
            figure.savefig(stream, format="png", facecolor=figure.get_facecolor())


def _write(figure: Figure, left: int, low: int, text: str, size: int = 15) -> None:
    """Write a line whose base begins at a pixel from the upper left corner."""
    if len(text) > _LONGEST:  # such as of long paths
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    figure.text(left / _SHEET[0], 1.0 - low / _SHEET[1], text, fontsize=size, parse_math=False)


def _direction(view: View) -> str:
    forward = view.axes[2]
    eighth = round(math.degrees(math.atan2(forward[1], forward[0])) / 45.0) % 8
    width_m = view.height_m * WIDTH / HEIGHT
    return (
        f"looking to {_DIRECTIONS[eighth]} and down, in parallel projection; {width_m:.3g} m wide; "
        "faces seen from behind (ceilings) are left out"
    )
