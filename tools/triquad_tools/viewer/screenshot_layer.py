"""Pictures of a scene, saved by the browser."""

import io
import re

import viser
from PIL import Image
from triquad_format.errors import TriquadError

from triquad_tools.viewer.caption import captioned
from triquad_tools.viewer.map_source import MapState
from triquad_tools.viewer.stage import Stage

_LONGER_PX = 1920  # side of a picture
_LONGEST_S = 60.0  # a browser without a graphics card takes seconds


class ScreenshotLayer:
    """A button that saves what the scene shows, with what one has to know of it below."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._button = stage.gui.add_button("Save picture", icon=viser.Icon.CAMERA)
        self._button.on_click(lambda _: self._save())

    def close(self) -> None:
        """Save no more."""
        self._button.remove()

    def _save(self) -> None:
        self._button.disabled = True
        try:
            state = self._stage.source.state()
            picture = captioned(self._picture(), state, self._stage.legends)
            encoded = io.BytesIO()
            picture.save(encoded, "PNG")
            self._stage.client.send_file_download(
                file_name(state), encoded.getvalue(), save_immediately=True
            )
            self._stage.failed("")
        except (TriquadError, TimeoutError) as error:
            self._stage.failed(f"no picture was saved: {error}")
        finally:
            self._button.disabled = False

    def _picture(self) -> Image.Image:
        """What is on the screen, on white; a slow browser draws coarser than this on its screen."""
        aspect = self._stage.client.camera.aspect
        width, height = (_LONGER_PX, round(_LONGER_PX / aspect))
        if aspect < 1.0:
            width, height = (round(_LONGER_PX * aspect), _LONGER_PX)
        pixels = self._stage.client.get_render(
            height, width, transport_format="png", timeout=_LONGEST_S
        )
        scene = Image.fromarray(pixels, "RGBA")
        white = Image.new("RGBA", scene.size, "white")
        return Image.alpha_composite(white, scene).convert("RGB")


def file_name(state: MapState) -> str:
    """The name of a picture: map, epoch, time."""
    words = [state.map_name, f"epoch-{state.epoch}", state.time.replace(":", "")]
    return re.sub(r"[^\w.-]+", "_", "_".join(filter(None, words))) + ".png"
