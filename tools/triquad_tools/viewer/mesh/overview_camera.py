"""A camera that shows all of a map until a person moves it."""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
import viser
from triquad_format.records.arrays import Doubles

from triquad_tools.plots.mesh_view import view_axes
from triquad_tools.viewer.page.page import Page

_NEAR_M, _FAR_M = 0.1, 20_000.0
_VIEW_RAD = math.radians(50.0)
_TOWARDS_EYE = np.array([-0.45, -0.65, 0.62])
_FRAMED = (1.0, 99.0)  # percentiles: what lies far away from all else does not make it small
_MARGIN = 1.05
_LEAST_ASPECT = 0.1
_GROWN = 0.02  # share of the camera's distance; a smaller step is not worth a jump
_SAME = 1e-3
_EYES = 64  # places where it was put last: what a browser reports is not as old as those before


class View(NamedTuple):
    """The camera's position and target: [3] metres, map frame."""

    eye: Doubles
    target: Doubles


def view_of(points: Doubles, aspect: float) -> View:
    """Return an oblique view from above of nearly all ``points`` [N, 3], at least one."""
    axes = view_axes(-_TOWARDS_EYE)
    seen = points @ axes.T
    middle = 0.5 * np.percentile(seen, _FRAMED, axis=0).sum(axis=0)
    right, down, ahead = (seen - middle).T
    tangent = math.tan(0.5 * _VIEW_RAD)
    needed = np.maximum(np.abs(right) / aspect, np.abs(down)) / tangent - ahead
    distance_m = _MARGIN * max(float(np.percentile(needed, _FRAMED[1])), _NEAR_M)
    return View((middle - [0.0, 0.0, distance_m]) @ axes, middle @ axes)


class OverviewCamera:
    """Moves the camera of a scene back as the map grows."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._taken = False
        camera = page.client.camera
        camera.fov, camera.near, camera.far = _VIEW_RAD, _NEAR_M, _FAR_M
        # The browser reports each place late: only one where it never was put is a person's.
        self._eyes = deque([np.array(camera.position)], _EYES)  # [3] in the scene
        camera.on_update(self._moved)

    def follow(self, points: Doubles) -> None:
        """Show all of ``points`` [N, 3], metres, map frame, unless a person moved the camera."""
        if self._taken or not len(points):
            return
        camera = self._page.client.camera
        view = view_of(points, max(camera.aspect, _LEAST_ASPECT))
        eye, target = self._page.in_scene(view.eye), self._page.in_scene(view.target)
        away_m = float(np.linalg.norm(eye - target))
        if float(np.linalg.norm(eye - self._eyes[-1])) > _GROWN * away_m:
            self._eyes.append(np.asarray(eye, np.float64))
            with self._page.client.atomic():
                camera.position = eye
                camera.look_at = target

    def _moved(self, camera: viser.CameraHandle) -> None:
        away_m = np.linalg.norm(np.array(self._eyes) - camera.position, axis=1)
        self._taken |= bool(away_m.min() > _SAME * (1.0 + np.linalg.norm(camera.position)))
