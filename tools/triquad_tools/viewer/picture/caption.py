"""What stands below a picture of a scene: the map, its state, and what colours and lines mean."""

from collections.abc import Sequence

import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont
from triquad_map.height_scale import GAMMA

from triquad_tools.viewer.page.colour_scale import ColourScale, scale_colours
from triquad_tools.viewer.page.legends import Legend, LineMeaning
from triquad_tools.viewer.sources.map_source import MapState

_TEXT_PX = 28
_ROW_PX = 40
_BAR_PX = (640, 20)
_LINE_PX = (80, 5)
_DASHES = 4
_MARGIN_PX = 20
_INK = "#222222"


def captioned(picture: Image.Image, state: MapState, legends: Sequence[Legend]) -> Image.Image:
    """The picture with a strip below it."""
    scales = [legend.scale for legend in legends if legend.scale is not None]
    lines = [line for legend in legends for line in legend.lines]
    rows = 1 + 2 * len(scales) + len(lines)
    height = picture.height + rows * _ROW_PX + 2 * _MARGIN_PX
    sheet = Image.new("RGB", (picture.width, height), "white")
    sheet.paste(picture)
    strip = _Strip(sheet, picture.height + _MARGIN_PX)
    strip.write(", ".join(filter(None, (state.map_name, f"epoch {state.epoch}", state.time))))
    for scale in scales:
        strip.draw_scale(scale)
    for line in lines:
        strip.draw_line(line)
    return sheet


class _Strip:
    """Rows from top to bottom of a sheet."""

    def __init__(self, sheet: Image.Image, top: int) -> None:
        self._sheet = sheet
        self._draw = ImageDraw.Draw(sheet)
        self._font = ImageFont.truetype(findfont("DejaVu Sans"), _TEXT_PX)
        self._top = top

    def write(self, text: str, left: int = _MARGIN_PX) -> None:
        """A row of text."""
        self._draw.text((left, self._top), text, _INK, self._font)
        self._top += _ROW_PX

    def draw_scale(self, scale: ColourScale) -> None:
        """A bar with its label beside it and its values below."""
        width, height = _BAR_PX
        colours = scale_colours(scale, np.linspace(scale.low, scale.high, width)) ** (1 / GAMMA)
        row = np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8)
        bar = np.ascontiguousarray(np.broadcast_to(row, (height, width, 3)))
        self._sheet.paste(Image.fromarray(bar), (_MARGIN_PX, self._top + 8))
        self.write(scale.label, 2 * _MARGIN_PX + width)
        texts = scale.tick_texts
        for number, text in enumerate(texts):
            anchor = "la" if number == 0 else "ra" if number == len(texts) - 1 else "ma"
            place = (_MARGIN_PX + number * width / (len(texts) - 1), self._top)
            self._draw.text(place, text, _INK, self._font, anchor)
        self._top += _ROW_PX

    def draw_line(self, line: LineMeaning) -> None:
        """A line, and what it says."""
        width, thickness = _LINE_PX
        middle = self._top + _TEXT_PX // 2
        pieces = _DASHES if line.dashed else 1
        step = width / pieces
        for number in range(pieces):
            left = _MARGIN_PX + number * step
            right = left + (0.6 * step if line.dashed else step)
            self._draw.line((left, middle, right, middle), line.colour, thickness)
        self.write(line.text, 2 * _MARGIN_PX + width)
