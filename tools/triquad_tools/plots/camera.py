"""Cameras: where they look from, and what lies where in their pictures."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles

_NEAR_M = 0.1  # what is nearer than this to the eye is not drawn
_VIEW_DEG = 35.0
_TOWARDS_EYE = np.array([-0.45, -0.65, 0.62])
_FRAMED = (1.0, 99.0)  # percentiles: what lies far away from all else does not make it small
_MARGIN = 1.05
_ENOUGH = 200_000  # vertices, to find the place of the camera
_ASPECT = 16 / 9


@dataclass(frozen=True)
class Camera:
    """A perspective camera in the map frame; the picture's top is towards +z."""

    eye: Doubles  # [3] metres
    target: Doubles  # [3] metres, in the middle of the picture
    view_deg: float = 35.0  # vertical opening angle

    @property
    def axes(self) -> Doubles:
        """Unit vectors ``[3, 3]``: to the right, down, and forward, in the map frame."""
        return view_axes(self.target - self.eye)

    def project(self, points: Doubles, width: int, height: int) -> Doubles:
        """Column, row and inverse depth ``[N, 3]`` of points ``[N, 3]``; NaN behind the eye."""
        seen = (points - self.eye) @ self.axes.T
        depth = np.where(seen[:, 2] > _NEAR_M, seen[:, 2], np.nan)
        pixels = self._pixels_per_tangent(height)
        column = 0.5 * width + pixels * seen[:, 0] / depth
        row = 0.5 * height + pixels * seen[:, 1] / depth
        return np.column_stack([column, row, 1.0 / depth])

    def unproject(self, nearness: Doubles) -> Doubles:
        """Points ``[H, W, 3]`` of the world that the pixels of a picture show."""
        height, width = nearness.shape
        pixels = self._pixels_per_tangent(height)
        right, down, forward = self.axes
        columns = (np.arange(width) + 0.5 - 0.5 * width) / pixels
        rows = (np.arange(height) + 0.5 - 0.5 * height) / pixels
        rays = columns[None, :, None] * right + rows[:, None, None] * down + forward
        points: Doubles = self.eye + rays / nearness[:, :, None]
        return points

    def _pixels_per_tangent(self, height: int) -> float:
        return 0.5 * height / math.tan(0.5 * math.radians(self.view_deg))


def camera_around(vertices: NDArray[np.floating]) -> Camera:
    """A camera that looks down aslant and has nearly all vertices ``[V, 3]`` in its picture."""
    if len(vertices) == 0:
        return Camera(_TOWARDS_EYE, np.zeros(3), _VIEW_DEG)
    some = vertices[:: max(1, len(vertices) // _ENOUGH)].astype(np.float64)
    axes = view_axes(-_TOWARDS_EYE)
    seen = some @ axes.T
    middle = 0.5 * np.percentile(seen, _FRAMED, axis=0).sum(axis=0)
    right, down, ahead = (seen - middle).T
    tangent = math.tan(0.5 * math.radians(_VIEW_DEG))
    needed = np.maximum(np.abs(right) / _ASPECT, np.abs(down)) / tangent - ahead
    distance_m = _MARGIN * np.percentile(needed, _FRAMED[1])
    return Camera((middle - [0.0, 0.0, distance_m]) @ axes, middle @ axes, _VIEW_DEG)


def view_axes(forward: Doubles) -> Doubles:
    """Unit vectors ``[3, 3]`` to the right, down and forward of a view in a direction ``[3]``."""
    forward = forward / np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
