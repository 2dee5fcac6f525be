"""Pictures of a scene, saved by the browser."""

import io
import re

import viser
from PIL import Image
from triquad_format.errors import TriquadError

from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.picture.caption import captioned
from triquad_tools.viewer.sources.map_source import MapState

_LONGER_PX = 1920  # side of a picture
_LONGEST_S = 60.0  # a browser without a graphics card takes seconds


class ScreenshotButton:
    """A button that saves what the scene shows, with what one has to know of it below."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._button = page.gui.add_button("Save picture", icon=viser.Icon.CAMERA)
        self._button.on_click(lambda _: self._save())

    def close(self) -> None:
        """Save no more."""
        self._button.remove()

    def _save(self) -> None:
        self._button.disabled = True
        try:
            state = self._page.source.state()
            picture = captioned(self._picture(), state, self._page.legends.shown())
            encoded = io.BytesIO()
            picture.save(encoded, "PNG")
            self._page.client.send_file_download(
                file_name(state), encoded.getvalue(), save_immediately=True
            )
            self._page.failed("")
        except (TriquadError, TimeoutError) as error:
            self._page.failed(f"no picture was saved: {error}")
        finally:
            self._button.disabled = False

    def _picture(self) -> Image.Image:
        """What is on the screen, on white; a slow browser draws coarser than this on its screen."""
        aspect = self._page.client.camera.aspect
        width, height = (_LONGER_PX, round(_LONGER_PX / aspect))
        if aspect < 1.0:
            width, height = (round(_LONGER_PX * aspect), _LONGER_PX)
        pixels = self._page.client.get_render(
            height, width, transport_format="png", timeout=_LONGEST_S
        )
        scene = Image.fromarray(pixels, "RGBA")
        white = Image.new("RGBA", scene.size, "white")
        return Image.alpha_composite(white, scene).convert("RGB")


def file_name(state: MapState) -> str:
    """The name of a picture: map, epoch, time."""
    words = [state.map_name, f"epoch-{state.epoch}", state.time.replace(":", "")]
    return re.sub(r"[^\w.-]+", "_", "_".join(filter(None, words))) + ".png"
