"""A camera that shows all of a map until a person takes it."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.plots.picture import camera_around
from triquad_tools.viewer.stage import Stage

_NEAR_M, _FAR_M = 0.1, 20_000.0
_VIEW_RAD = math.radians(50.0)
_GROWN = 0.02  # share of the camera's distance; a smaller step is not worth a jump
_SAME = 1e-3


class Framing:
    """Moves the camera of a scene back as the map grows."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._eye: Doubles | None = None  # [3] where it was put last, in the scene
        self._taken = False
        stage.client.camera.fov = _VIEW_RAD
        stage.client.camera.near = _NEAR_M
        stage.client.camera.far = _FAR_M

    def follow(self, points: Doubles) -> None:
        """Show all of ``points`` [N, 3], metres, map frame, unless a person moved the camera."""
        camera = self._stage.client.camera
        if self._eye is not None and not self._taken:
            away_m = float(np.linalg.norm(camera.position - self._eye))
            self._taken = away_m > _SAME * (1.0 + float(np.linalg.norm(self._eye)))
        if self._taken or not len(points):
            return
        around = camera_around(points)
        closer = math.tan(0.5 * math.radians(around.view_deg)) / math.tan(0.5 * _VIEW_RAD)
        target = self._stage.in_scene(around.target)
        eye = target + closer * (self._stage.in_scene(around.eye) - target)
        step_m = np.inf if self._eye is None else float(np.linalg.norm(eye - self._eye))
        if step_m > _GROWN * float(np.linalg.norm(eye - target)):
            with self._stage.client.atomic():
                camera.position = eye
                camera.look_at = target
            self._eye = np.asarray(camera.position)
