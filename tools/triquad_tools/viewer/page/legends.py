"""What colours and lines of a scene mean: in the panel, and for who saves a picture of it."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from matplotlib.colors import to_hex

from triquad_tools.viewer.page.colour_scale import ColourScale


class LineMeaning(NamedTuple):
    """What lines that look alike say."""

    colour: str  # as in #rrggbb
    dashed: bool
    text: str


@dataclass(frozen=True)
class Legend:
    """What one part of a page draws."""

    scale: ColourScale | None = None
    lines: Sequence[LineMeaning] = ()

    @property
    def html(self) -> str:
        """The legend for the panel."""
        scale = "" if self.scale is None else _scale_html(self.scale)
        return scale + "".join(map(_line_html, self.lines))


class ShownLegends:
    """The legends of all that one page shows now; for several threads."""

    def __init__(self) -> None:
        self._legends: dict[str, Legend] = {}
        self._changing = threading.Lock()

    def show(self, name: str, legend: Legend) -> None:
        """Enter or replace the legend of what a part of the page draws."""
        with self._changing:
            self._legends[name] = legend

    def hide(self, name: str) -> None:
        """Take it away, where there is one."""
        with self._changing:
            self._legends.pop(name, None)

    def shown(self) -> tuple[Legend, ...]:
        """All of them."""
        with self._changing:
            return tuple(self._legends.values())


def _scale_html(scale: ColourScale) -> str:
    stops = ", ".join(to_hex(stop) for stop in scale.stops)
    ticks = "".join(f"<span>{text}</span>" for text in scale.tick_texts)
    return (
        '<div style="padding: 0.2em 1em; font-size: 0.8em">'
        f"<div>{scale.label}</div>"
        f'<div style="height: 0.8em; background: linear-gradient(to right, {stops})"></div>'
        f'<div style="display: flex; justify-content: space-between">{ticks}</div></div>'
    )


def _line_html(line: LineMeaning) -> str:
    return (
        '<div style="padding: 0 1.3em; font-size: 0.8em">'
        '<span style="display: inline-block; width: 2.5em; vertical-align: middle; '
        f"margin-right: 0.6em; border-top: 3px {'dashed' if line.dashed else 'solid'} "
        f'{line.colour}"></span>{line.text}</div>'
    )
