"""What stands below a picture of a scene: the map, its state, and the scales of colours."""

from collections.abc import Sequence

import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from triquad_tools.viewer.legend import Scale, scale_colours
from triquad_tools.viewer.map_source import MapState

_TEXT_PX = 16
_ROW_PX = 24
_BAR_PX = (256, 12)
_MARGIN_PX = 12
_INK = "#222222"


def captioned(picture: Image.Image, state: MapState, scales: Sequence[Scale]) -> Image.Image:
    """The picture with a strip below it."""
    rows = 1 + 2 * len(scales)
    height = picture.height + rows * _ROW_PX + 2 * _MARGIN_PX
    sheet = Image.new("RGB", (picture.width, height), "white")
    sheet.paste(picture)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.truetype(findfont("DejaVu Sans"), _TEXT_PX)
    top = picture.height + _MARGIN_PX
    draw.text((_MARGIN_PX, top), _told(state), _INK, font)
    for scale in scales:
        top += _ROW_PX
        _draw_scale(sheet, scale, top, font)
        top += _ROW_PX
    return sheet


def _told(state: MapState) -> str:
    return ", ".join(filter(None, (f"map {state.map_name}", f"epoch {state.epoch}", state.time)))


def _draw_scale(sheet: Image.Image, scale: Scale, top: int, font: ImageFont.FreeTypeFont) -> None:
    """A bar with its label beside it and its values below."""
    draw = ImageDraw.Draw(sheet)
    width, height = _BAR_PX
    colours = scale_colours(scale, np.linspace(scale.low, scale.high, width)) ** (1 / 2.2)
    bar = np.broadcast_to(np.round(255 * colours).astype(np.uint8), (height, width, 3))
    sheet.paste(Image.fromarray(np.ascontiguousarray(bar)), (_MARGIN_PX, top + 6))
    draw.text((2 * _MARGIN_PX + width, top), scale.label, _INK, font)
    texts = scale.tick_texts
    for place, text in zip(np.linspace(0, width, len(texts)), texts, strict=True):
        anchor = "la" if place == 0 else "ra" if place == width else "ma"
        draw.text((_MARGIN_PX + place, top + _ROW_PX), text, _INK, font, anchor)
