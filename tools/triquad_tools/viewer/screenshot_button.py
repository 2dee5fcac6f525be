"""Pictures of a scene with its legends, saved by the browser."""

import io
import re
from collections.abc import Sequence

import numpy as np
import viser
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image
from triquad_format.errors import TriquadError

from triquad_tools.viewer.page.legends import Legend
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.sources.map_source import MapState

_LONGER_PX = 1920  # side of a picture
_LONGEST_S = 60.0  # a browser without a graphics card takes seconds
_DPI, _ROW_IN, _BAR = 160, 0.3, (0.02, 0.35)  # a row of the caption; left and width of a scale


class ScreenshotButton:
    """A button that saves what the scene shows, with a caption below."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._button = page.gui.add_button("Save picture", icon=viser.Icon.CAMERA)
        self._button.on_click(lambda _: self._save())

    def close(self) -> None:
        """Save no more."""
        self._button.remove()

    def _save(self) -> None:
        self._button.disabled = True
        problem = ""
        try:
            state, packed = self._page.source.state(), io.BytesIO()
            captioned(self._picture(), state, list(self._page.legends.values())).save(packed, "PNG")
            words = [state.map_name, f"epoch-{state.epoch}", state.time.replace(":", "")]
            name = re.sub(r"[^\w.-]+", "_", "_".join(filter(None, words))) + ".png"
            self._page.client.send_file_download(name, packed.getvalue(), save_immediately=True)
        except (TriquadError, TimeoutError) as error:
            problem = f"no picture was saved: {error}"
        finally:
            self._page.failed("picture", problem)
            self._button.disabled = False

    def _picture(self) -> Image.Image:
        """Return the scene on white; a slow browser draws coarser than this on its screen."""
        aspect = self._page.client.camera.aspect
        width, height = round(_LONGER_PX * min(aspect, 1)), round(_LONGER_PX / max(aspect, 1))
        pixels = self._page.client.get_render(
            height, width, transport_format="png", timeout=_LONGEST_S
        )
        scene = Image.fromarray(pixels, "RGBA")
        return Image.alpha_composite(Image.new("RGBA", scene.size, "white"), scene).convert("RGB")


def captioned(picture: Image.Image, state: MapState, legends: Sequence[Legend]) -> Image.Image:
    """Return the picture with a strip below: the map, its state, and what its colours mean."""
    scales = [legend.scale for legend in legends if legend.scale is not None]
    lines = [line for legend in legends for line in legend.lines]
    rows = 2 + 2 * len(scales) + len(lines)
    row = 1.0 / rows
    strip = Figure((picture.width / _DPI, rows * _ROW_IN), _DPI)
    title = ", ".join(filter(None, (state.map_name, f"epoch {state.epoch}", state.time)))
    strip.text(_BAR[0], 1.0 - row, title)
    for number, scale in enumerate(scales):
        low = 1.0 - (2.5 + 2 * number) * row
        axes = strip.add_axes((*(_BAR[0], low), _BAR[1], 0.7 * row))
        axes.imshow(np.linspace(0.0, 1.0, 256)[None], aspect="auto", cmap=scale.colours)
        axes.set(yticks=[], xticks=np.linspace(0, 255, len(scale.ticks)), xticklabels=scale.ticks)
        strip.text(_BAR[0] + _BAR[1] + 0.02, low + 0.1 * row, scale.label)
    drawn = [
        Line2D([], [], color=c, label=text, linestyle=style, linewidth=3)
        for c, text, style in lines
    ]
    if drawn:
        strip.legend(handles=drawn, loc="lower left", frameon=False, edgecolor="black")
    packed = io.BytesIO()
    strip.savefig(packed, format="png")
    caption = Image.open(packed).convert("RGB")
    sheet = Image.new("RGB", (picture.width, picture.height + caption.height), "white")
    sheet.paste(picture)
    sheet.paste(caption, (0, picture.height))
    return sheet
