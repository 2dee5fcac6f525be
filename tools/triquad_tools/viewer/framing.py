"""A camera that shows all of a map until a person takes it."""

import math

import numpy as np
import viser
from triquad_format.records.arrays import Doubles

from triquad_tools.plots.camera import camera_around
from triquad_tools.viewer.stage import Stage

_NEAR_M, _FAR_M = 0.1, 20_000.0
_VIEW_RAD = math.radians(50.0)
_PICTURE_ASPECT = 16 / 9  # for which that camera was placed
_GROWN = 0.02  # share of the camera's distance; a smaller step is not worth a jump
_SAME = 1e-3


class Framing:
    """Moves the camera of a scene back as the map grows."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._taken = False
        camera = stage.client.camera
        camera.fov = _VIEW_RAD
        camera.near = _NEAR_M
        camera.far = _FAR_M
        # The browser tells of each place late: only one where it never was put is a person's.
        self._eyes = [np.array(camera.position)]  # [3] in the scene
        camera.on_update(self._moved)

    def follow(self, points: Doubles) -> None:
        """Show all of ``points`` [N, 3], metres, map frame, unless a person moved the camera."""
        if self._taken or not len(points):
            return
        around = camera_around(points)
        closer = math.tan(0.5 * math.radians(around.view_deg)) / math.tan(0.5 * _VIEW_RAD)
        closer *= max(1.0, _PICTURE_ASPECT / max(self._stage.client.camera.aspect, 0.1))
        target = self._stage.in_scene(around.target)
        eye = target + closer * (self._stage.in_scene(around.eye) - target)
        away_m = float(np.linalg.norm(eye - target))
        if float(np.linalg.norm(eye - self._eyes[-1])) > _GROWN * away_m:
            self._eyes.append(np.asarray(eye, np.float64))
            camera = self._stage.client.camera
            with self._stage.client.atomic():
                camera.position = eye
                camera.look_at = target

    def _moved(self, camera: viser.CameraHandle) -> None:
        away_m = np.linalg.norm(np.array(self._eyes) - camera.position, axis=1)
        self._taken |= bool(away_m.min() > _SAME * (1.0 + np.linalg.norm(camera.position)))
