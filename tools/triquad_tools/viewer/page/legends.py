"""The meaning of colours and lines of a scene, and texts in the panel of a page.

Texts from the network are shown as they are.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from html import escape

import numpy as np
from matplotlib.colors import Colormap, to_hex
from triquad_format.printable import printable_lines
from triquad_format.records.arrays import Doubles

_TICKS = 5
_TEXT = "padding: 0.2em 1em; font-size: 0.8em; line-height: 1.4; overflow-wrap: anywhere"


@dataclass(frozen=True)
class ColourScale:
    """Colours for values from ``low`` to ``high``; what is beyond has those of the ends."""

    label: str  # with the unit
    colours: Colormap
    low: float
    high: float
    open_below: bool = False  # there may be values below
    open_above: bool = False
    told: Callable[[Doubles], Doubles] = lambda values: values  # what labels say of them

    @property
    def html(self) -> str:
        """The scale for the panel, with labels at equal steps."""
        stops = ", ".join(to_hex(colour) for colour in self.colours(np.linspace(0.0, 1.0, 17)))
        ticks = self.told(np.linspace(self.low, self.high, _TICKS))
        texts = [f"{round(tick, 2):.3g}" for tick in ticks]
        texts[0] = f"≤ {texts[0]}" if self.open_below else texts[0]
        texts[-1] = f"≥ {texts[-1]}" if self.open_above else texts[-1]
        labels = "".join(f"<span>{text}</span>" for text in texts)
        return (
            f'<div style="padding: 0.2em 1em; font-size: 0.8em"><div>{self.label}</div>'
            f'<div style="height: 0.8em; background: linear-gradient(to right, {stops})"></div>'
            f'<div style="display: flex; justify-content: space-between">{labels}</div></div>'
        )


def lines_html(*lines: tuple[str, str]) -> str:
    """Return colours, as in #rrggbb, and the meaning of lines that have them."""
    return "".join(
        f'<div style="padding: 0 1.3em; font-size: 0.8em"><span style="display: inline-block; '
        "width: 2.5em; vertical-align: middle; margin-right: 0.6em; "
        f'border-top: 3px solid {colour}; outline: 1px solid #8886"></span>{text}</div>'
        for colour, text in lines
    )


def scale_html(length_m: float, pixels: float) -> str:
    """Return a bar of some ``pixels``, as long as ``length_m`` in the middle of a scene."""
    bar = f"width: {pixels:.0f}px; height: 0.4em; border: 2px solid; border-top: 0"
    return f'<div style="{_TEXT}"><div style="{bar}"></div>{length_m:g} m in the middle</div>'


def compass_html(turn_deg: float) -> str:
    """Return an arrow along the map's x axis, on a screen that shows ``turn_deg`` as up.

    The angle is counted from the x axis towards the y axis.
    """
    arrow = f"display: inline-block; transform: rotate({turn_deg - 90.0:.0f}deg)"
    told = f"x axis; the view looks {turn_deg:.0f}° from it"
    return f'<div style="{_TEXT}"><span style="{arrow}">⟶</span> {told}</div>'


def text_html(text: str) -> str:
    """Return a text, line by line; nothing where it is empty."""
    shown = f'<div style="{_TEXT}; white-space: pre-line">{_shown(text)}</div>'
    return shown if text else ""


def problem_html(text: str) -> str:
    """Return a problem with a sign before it; nothing if the text is empty."""
    style = f"{_TEXT}; color: #9a3412; font-weight: bold"
    return f'<div style="{style}">⚠ {_shown(text)}</div>' if text else ""


def table_html(rows: Iterable[tuple[str, str]]) -> str:
    """Return names and values, in two columns."""
    cells = "".join(
        f'<tr><td style="padding-right: 1em; opacity: 0.7">{_shown(name)}</td>'
        f"<td>{_shown(value)}</td></tr>"
        for name, value in rows
    )
    return f'<table style="{_TEXT}">{cells}</table>'


def _shown(text: str) -> str:
    """Escape a text, so that it neither makes elements of the page nor reverses its writing."""
    return escape(printable_lines(text))
