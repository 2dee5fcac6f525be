"""Cameras: from the map frame to a picture and back."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from triquad_format.records.arrays import Doubles

_NEAR_M = 0.1  # what is nearer than this to the eye is not drawn


class Camera(Protocol):
    """Where a picture is taken from; its top is towards +z.

    What is nearer hides what is farther; the nearness of a place is any number that is linear in
    the picture and grows towards the eye.
    """

    @property
    def axes(self) -> Doubles:
        """Unit vectors ``[3, 3]``: to the right, down, and forward, in the map frame."""

    def project(self, points: Doubles, width: int, height: int) -> Doubles:
        """Column, row and nearness ``[N, 3]`` of points ``[N, 3]``; NaN where it sees none."""

    def unproject(self, nearness: Doubles) -> Doubles:
        """Points ``[H, W, 3]`` of the world that the pixels of a picture show."""

    def towards_eye(self, places: Doubles) -> Doubles:
        """Vectors ``[N, 3]`` of any length from places ``[N, 3]`` to the eye."""

    def relative_depth(self, nearness: Doubles) -> Doubles:
        """Depth, by the height of what the picture shows there."""


@dataclass(frozen=True)
class PerspectiveCamera:
    """A camera like the human eye: what is farther away is smaller."""

    eye: Doubles  # [3] metres, map frame
    target: Doubles  # [3] metres, in the middle of the picture
    view_deg: float = 35.0  # vertical opening angle

    @property
    def axes(self) -> Doubles:
        """See :class:`Camera`."""
        return view_axes(self.target - self.eye)

    def project(self, points: Doubles, width: int, height: int) -> Doubles:
        """See :class:`Camera`; the nearness is the inverse depth."""
        seen = (points - self.eye) @ self.axes.T
        depth = np.where(seen[:, 2] > _NEAR_M, seen[:, 2], np.nan)
        pixels = 0.5 * height / self._tangent
        column = 0.5 * width + pixels * seen[:, 0] / depth
        row = 0.5 * height + pixels * seen[:, 1] / depth
        return np.column_stack([column, row, 1.0 / depth])

    def unproject(self, nearness: Doubles) -> Doubles:
        """See :class:`Camera`."""
        right, down, forward = self.axes
        columns, rows = _pixels(nearness.shape)
        rays = self._tangent * (columns * right + rows * down) + forward
        points: Doubles = self.eye + rays / nearness[:, :, None]
        return points

    def towards_eye(self, places: Doubles) -> Doubles:
        """See :class:`Camera`."""
        vectors: Doubles = self.eye - places
        return vectors

    def relative_depth(self, nearness: Doubles) -> Doubles:
        """See :class:`Camera`; a logarithm, as the height grows with the depth."""
        return np.log(1.0 / nearness) / (2.0 * self._tangent)

    @property
    def _tangent(self) -> float:
        return math.tan(0.5 * math.radians(self.view_deg))


@dataclass(frozen=True)
class ParallelCamera:
    """A camera from infinitely far away: a metre is as long everywhere in the picture."""

    from_eye: Doubles  # [3] the direction in which it looks
    target: Doubles  # [3] metres, in the middle of the picture
    height_m: float  # of what the picture shows, across the view

    @property
    def axes(self) -> Doubles:
        """See :class:`Camera`."""
        return view_axes(self.from_eye)

    def project(self, points: Doubles, width: int, height: int) -> Doubles:
        """See :class:`Camera`; the nearness is in metres before the target."""
        pixels = height / self.height_m
        seen = (points - self.target) @ self.axes.T
        column, row = 0.5 * width + pixels * seen[:, 0], 0.5 * height + pixels * seen[:, 1]
        return np.column_stack([column, row, -seen[:, 2]])

    def unproject(self, nearness: Doubles) -> Doubles:
        """See :class:`Camera`."""
        right, down, forward = self.axes
        columns, rows = _pixels(nearness.shape)
        across = 0.5 * self.height_m * (columns * right + rows * down)
        points: Doubles = self.target + across - nearness[:, :, None] * forward
        return points

    def towards_eye(self, places: Doubles) -> Doubles:
        """See :class:`Camera`."""
        return np.broadcast_to(-self.from_eye, places.shape)

    def relative_depth(self, nearness: Doubles) -> Doubles:
        """See :class:`Camera`."""
        return -nearness / self.height_m


def view_axes(forward: Doubles) -> Doubles:
    """Unit vectors ``[3, 3]`` to the right, down and forward of a view in a direction ``[3]``."""
    forward = forward / np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


class _Pixels(NamedTuple):
    """Middles of pixels, from that of the picture, in halves of its height."""

    columns: Doubles  # [1, W, 1]
    rows: Doubles  # [H, 1, 1]


def _pixels(shape: tuple[int, ...]) -> _Pixels:
    height, width = shape
    columns = (np.arange(width) - 0.5 * (width - 1)) / np.float64(0.5 * height)
    rows = (np.arange(height) - 0.5 * (height - 1)) / np.float64(0.5 * height)
    return _Pixels(columns[None, :, None], rows[:, None, None])
