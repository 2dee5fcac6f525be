"""Curves of measured points in panels of one picture: a marker and a line style for each, too."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

_PANEL_IN = (4.4, 3.3)
_HEAD_IN = 1.6  # of the title, the legend and the notes
_DPI = 110
_LETTERS_PT = 13  # can be read in half the size, too


class Style(NamedTuple):
    """How a curve is drawn, as matplotlib names it."""

    colour: str
    marker: str
    line: str


STYLES = (Style("#0072b2", "o", "-"), Style("#d55e00", "s", "--"), Style("#009e73", "^", ":"))
"""Of the first, second and third curve (colours of Okabe and Ito)."""


@dataclass(frozen=True)
class Curve:
    """Measured points, joined in the order of their abscissae."""

    label: str
    style: Style
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """One pair of axes; its abscissa is logarithmic, with marks where ``ticks`` are.

    Labels with units are shown at the outer panels alone: a column shares its abscissa, a row its
    ordinate.
    """

    heading: str
    across: str
    upwards: str
    ticks: Sequence[float]
    limits: tuple[float | None, float | None]  # of the ordinate of its row; None: as points are
    curves: Sequence[Curve]


def save_panels(
    path: Path, title: str, panels: Sequence[Sequence[Panel]], notes: Sequence[str]
) -> None:
    """Draw rows of panels, as many in each, with one legend and notes below.

    Raises:
        OSError: ``path`` cannot be written.
    """
    shape = (len(panels), len(panels[0]))
    size = (shape[1] * _PANEL_IN[0], shape[0] * _PANEL_IN[1] + _HEAD_IN)
    with rc_context({"font.size": _LETTERS_PT}):
        figure = Figure(size, _DPI, layout="constrained")
        figure.suptitle(title, x=0.01, ha="left")
        places = figure.subplots(*shape, squeeze=False, sharex="col", sharey="row")
        for axes, panel in zip(places.flat, (one for row in panels for one in row), strict=True):
            _draw(axes, panel)
        for axes, row in zip(places[:, 0], panels, strict=True):
            axes.set_ylim(*row[0].limits)  # now: what is drawn later would not widen it
        named = {handle.get_label(): handle for axes in places.flat for handle in axes.get_lines()}
        figure.legend(handles=list(named.values()), loc="outside lower left", frameon=False)
        figure.supxlabel("\n".join(notes), x=0.99, ha="right", fontsize="small")
        figure.savefig(path)


def _draw(axes: Axes, panel: Panel) -> None:
    axes.set_title(panel.heading, loc="left", fontsize="medium")
    axes.set(xlabel=panel.across, ylabel=panel.upwards, xscale="log")
    axes.grid(color="#dddddd")
    for curve in panel.curves:
        style = curve.style
        across, upwards = zip(*sorted(curve.points), strict=True)
        axes.plot(
            across, upwards, style.line, color=style.colour, marker=style.marker, ms=8,
            label=curve.label,
        )  # fmt: skip
    axes.set_xticks(panel.ticks)
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.label_outer()
