"""A picture of plans beside or below each other, each with axes in metres and a legend."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from triquad_tools.plots.colour_scale import ColourScale
from triquad_tools.plots.plan_grid import MOST_CELLS, PlanGrid

_PAPER, _INK, _FAINT, _NOTHING = "#ffffff", "#1d2733", "#8a94a0", "#f3f4f6"
_TITLE, _HEADING, _TEXT = 20, 18, 14  # sizes of letters, pixels
_MARGIN = 28  # around the picture and between plans
_LEFT, _ABOVE, _BELOW = 52, 34, 56  # room for numbers, heading and numbers of a plan
_LINE, _TITLE_LINE = 24, 28  # from one line of a legend, or of the title, to the next
_TICK, _TICK_GAP = 5, 80  # length of a tick; from one to the next, at least
_BAR_WIDTH, _BAR_HEIGHT, _BAR_LINES = 240, 12, 3
_NOTE_HEIGHT = 120  # of a plan that has no picture
_LONGEST_BESIDE = 800  # side of plans that stand beside each other, pixels, where cells can grow
_WIDE = 1.4  # the plans of a map that is wider stand below each other


@dataclass(frozen=True)
class Swatch:
    """What a colour stands for."""

    colour: str
    label: str


@dataclass(frozen=True)
class Panel:
    """One plan and its legend."""

    heading: str
    picture: NDArray[np.uint8] | None  # [rows, columns, 3] of the grid; None: there is none
    scale: ColourScale | None = None
    swatches: tuple[Swatch, ...] = ()
    note: str = ""  # the legend's last line; stands in the place of a picture that is not there


def draw_sheet(titles: Sequence[str], grid: PlanGrid, panels: Sequence[Panel]) -> Image.Image:
    """The plans of one grid as one picture, with lines of text above."""
    longest = MOST_CELLS if _is_wide(grid) else _LONGEST_BESIDE
    zoom = max(longest // max(grid.rows, grid.columns), 1)
    places = _places(grid, panels, zoom, _MARGIN + len(titles) * _TITLE_LINE)
    right = max(place.right for place in places) + _MARGIN
    image = Image.new("RGB", (right, max(place.bottom for place in places)), _PAPER)
    draw = ImageDraw.Draw(image)
    for number, title in enumerate(titles):
        at = (_MARGIN, _MARGIN + number * _TITLE_LINE)
        draw.text(at, _shortened(title, right - 2 * _MARGIN), _INK, _font(_TITLE))
    for panel, place in zip(panels, places, strict=True):
        _Plan(image, grid, zoom, place).draw(panel)
    return image


@dataclass(frozen=True)
class _Place:
    """The pixels of a plan with its legend."""

    left: int
    top: int
    right: int
    bottom: int


def _places(grid: PlanGrid, panels: Sequence[Panel], zoom: int, top: int) -> list[_Place]:
    """Side by side, or below each other where the map is wide."""
    width = zoom * grid.columns
    heights = [_height(panel, zoom * grid.rows, width) for panel in panels]
    step = _MARGIN + _LEFT + width
    if _is_wide(grid):
        tops = [top + _MARGIN + sum(heights[:number]) for number in range(len(panels))]
        return [
            _Place(_MARGIN, top, step, top + height)
            for top, height in zip(tops, heights, strict=True)
        ]
    return [
        _Place(_MARGIN + number * step, top + _MARGIN, (number + 1) * step, top + _MARGIN + height)
        for number, height in enumerate(heights)
    ]


def _is_wide(grid: PlanGrid) -> bool:
    return grid.columns > _WIDE * grid.rows


def _height(panel: Panel, plan_height: int, width: int) -> int:
    if panel.picture is None:
        return _ABOVE + _NOTE_HEIGHT + _MARGIN
    bar = _BAR_LINES if panel.scale is not None else 0
    lines = bar + len(_lines(panel.swatches, width)) + bool(panel.note)
    return _ABOVE + plan_height + _BELOW + lines * _LINE + _MARGIN


class _Plan:
    """One plan of a picture, whose map begins at a pixel."""

    def __init__(self, image: Image.Image, grid: PlanGrid, zoom: int, place: _Place) -> None:
        self._image = image
        self._draw = ImageDraw.Draw(image)
        self._grid = grid
        self._zoom = zoom
        self._pixels_per_m = zoom / grid.cell_m
        self._left, self._top = place.left + _LEFT, place.top + _ABOVE
        self._right, self._bottom = place.right, self._top + zoom * grid.rows

    def draw(self, panel: Panel) -> None:
        self._text((self._left, self._top - 10), panel.heading, "ls", _HEADING)
        if panel.picture is None:
            below = self._top + _NOTE_HEIGHT
            self._draw.rectangle((self._left, self._top, self._right, below), _NOTHING)
            middle = ((self._left + self._right) / 2, (self._top + below) / 2)
            self._text(middle, panel.note, "mm")
            return
        picture = panel.picture.repeat(self._zoom, axis=0).repeat(self._zoom, axis=1)
        self._image.paste(Image.fromarray(picture), (self._left, self._top))
        self._frame()
        self._scale_bar()
        self._legend(panel)

    def _frame(self) -> None:
        """A frame with ticks, in metres."""
        edges = (self._left - 1, self._top - 1, self._right, self._bottom)
        self._draw.rectangle(edges, outline=_FAINT)
        low, high = self._grid.low_m, self._grid.high_m
        step = _round_up(_TICK_GAP / self._pixels_per_m)
        for x in _multiples(low[0], high[0], step):
            at = self._left + (x - low[0]) * self._pixels_per_m
            self._draw.line((at, self._bottom, at, self._bottom + _TICK), _FAINT)
            self._text((at, self._bottom + _TICK + 4), f"{x:g}", "mt")
        for y in _multiples(low[1], high[1], step):
            at = self._bottom - (y - low[1]) * self._pixels_per_m
            self._draw.line((self._left - 1 - _TICK, at, self._left - 1, at), _FAINT)
            self._text((self._left - _TICK - 4, at), f"{y:g}", "rm")
        self._text((self._right, self._bottom + _TICK + 22), "x, y in m", "rt")

    def _scale_bar(self) -> None:
        """A bar of a round length, in the corner."""
        metres = _round_up((self._right - self._left) / 10 / self._pixels_per_m)
        left, bottom = self._left + 12, self._bottom - 14
        right = left + metres * self._pixels_per_m
        self._draw.rectangle((left - 2, bottom - 5, right + 2, bottom + 2), _PAPER)
        self._draw.rectangle((left, bottom - 3, right, bottom), _INK)
        place = ((left + right) / 2, bottom - 8)
        self._draw.text(
            place, f"{metres:g} m", _INK, _font(_TEXT), "ms", stroke_width=3, stroke_fill=_PAPER
        )

    def _legend(self, panel: Panel) -> None:
        top = self._bottom + _BELOW
        if panel.scale is not None:
            self._colour_bar(panel.scale, top)
            top += _BAR_LINES * _LINE
        for line in _lines(panel.swatches, self._right - self._left):
            left = float(self._left)
            for swatch in line:
                box = (left, top + 1, left + 16, top + 15)
                self._draw.rectangle(box, swatch.colour, _FAINT)
                self._text((left + 23, top + 8), swatch.label, "lm")
                left += _swatch_width(swatch)
            top += _LINE
        self._text((self._left, top + 8), panel.note, "lm")

    def _colour_bar(self, scale: ColourScale, top: int) -> None:
        self._text((self._left, top + 8), scale.label, "lm")
        top += _LINE
        ramp = np.linspace(scale.low, scale.high, _BAR_WIDTH)[None].repeat(_BAR_HEIGHT, axis=0)
        self._image.paste(Image.fromarray(scale.colours(ramp)), (self._left, top))
        self._draw.rectangle(
            (self._left - 1, top - 1, self._left + _BAR_WIDTH, top + _BAR_HEIGHT), outline=_FAINT
        )
        span = max(scale.high - scale.low, 1e-9)
        for value in _multiples(scale.low, scale.high, _round_up(span / 6)):
            at = self._left + (value - scale.low) / span * _BAR_WIDTH
            self._draw.line((at, top + _BAR_HEIGHT, at, top + _BAR_HEIGHT + 3), _FAINT)
            self._text((at, top + _BAR_HEIGHT + 7), f"{value:g}", "mt")

    def _text(self, place: tuple[float, float], text: str, anchor: str, size: int = _TEXT) -> None:
        self._draw.text(place, text, _INK, _font(size), anchor)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _shortened(title: str, width: int) -> str:
    while title and _font(_TITLE).getlength(title) > width:
        title = title[:-4] + "..."
    return title


def _lines(swatches: Sequence[Swatch], width: float) -> list[list[Swatch]]:
    """Swatches in lines that are not wider than ``width``, where one does not fill it alone."""
    lines: list[list[Swatch]] = []
    for swatch in swatches:
        if lines and sum(map(_swatch_width, [*lines[-1], swatch])) <= width:
            lines[-1].append(swatch)
        else:
            lines.append([swatch])
    return lines


def _swatch_width(swatch: Swatch) -> float:
    return 23 + _font(_TEXT).getlength(swatch.label) + 22


def _round_up(length: float) -> float:
    """The least of 1, 2 and 5 times powers of ten that is not below ``length``."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(power * digit for digit in (1, 2, 5, 10) if power * digit >= length * (1 - 1e-9))


def _multiples(low: float, high: float, step: float) -> list[float]:
    """Multiples of ``step`` from ``low`` to ``high``."""
    numbers = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return [round(number * step, 9) for number in numbers]
