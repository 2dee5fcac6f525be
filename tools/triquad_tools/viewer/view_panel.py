"""The view of a page: its scale and direction, and cameras that look from a chosen side."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.mesh.mesh_layer import MeshLayer
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import compass_html, scale_html
from triquad_tools.viewer.page.page import Page

_PERIOD_S = 0.5
_ALL, _TOP, _SIDE = "All", "Top", "Side"
_SIDE_RISE = 0.1  # of a view from the side, so that the ground is not a line
_NOT_QUITE = 1e-3  # from straight above, "up" on the screen would be any direction
_BAR_PIXELS = 120  # at most


class ViewPanel(Layer):
    """Tells how large and which way round things are, and turns the camera."""

    def __init__(self, page: Page, mesh: MeshLayer) -> None:
        super().__init__(page, "View", _PERIOD_S)
        self._mesh = mesh
        with self.folder:
            self._from = page.gui.add_button_group("Look at", (_ALL, _TOP, _SIDE))
            self.add_text()
        self._from.on_click(lambda _: self._turn(self._from.value))
        page.client.camera.on_update(self.wake)
        self.start()

    def refresh(self) -> None:
        """Tell the scale at what the camera is turned about, and where it looks."""
        camera, eye, middle = self.page.client.camera, self.page.eye, self.page.focus.middle
        away_m = float(np.linalg.norm(middle - eye))
        pixel_m = 2.0 * away_m * math.tan(0.5 * camera.fov) / max(camera.image_height, 1)
        length_m = round_length(_BAR_PIXELS * pixel_m)
        ahead = middle - eye
        turn_deg = math.degrees(math.atan2(ahead[1], ahead[0]))
        self.tell(scale_html(length_m, length_m / max(pixel_m, 1e-9)) + compass_html(turn_deg))

    def _turn(self, to: str) -> None:
        """Look at all that was seen, or at what is in the middle from another side."""
        if to == _ALL:
            self._mesh.show_all()
            return
        camera, eye, middle = self.page.client.camera, self.page.eye, self.page.focus.middle
        back = turned_back(eye - middle, level=to == _SIDE)
        with self.page.client.atomic():
            camera.position = self.page.in_scene(middle + back)
            camera.look_at = self.page.in_scene(middle)


def turned_back(back: Doubles, *, level: bool) -> Doubles:
    """Return a way back to the eye, as long as ``back`` [3], that is nearly level or upright."""
    away_m = float(np.linalg.norm(back))
    aside = math.hypot(back[0], back[1])
    ground = np.array([back[0], back[1], 0.0]) / aside if aside > 0 else np.array([0.0, -1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    turned = ground + _SIDE_RISE * up if level else up + _NOT_QUITE * ground
    return np.asarray(away_m * turned / np.linalg.norm(turned), np.float64)


def round_length(most_m: float) -> float:
    """Return the longest length of 1, 2 or 5 times a power of ten that is no longer, metres."""
    power = 10.0 ** math.floor(math.log10(max(most_m, 1e-6)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= most_m or step == 1))
