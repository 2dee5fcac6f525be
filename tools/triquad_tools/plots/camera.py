"""Where a picture is taken from, and where a point of the world appears in it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NEAR_M = 0.1  # what is nearer than this to the eye is not drawn


@dataclass(frozen=True)
class Camera:
    """A perspective camera in the map frame; the picture's top is towards +z."""

    eye: NDArray[np.float64]  # [3] metres
    target: NDArray[np.float64]  # [3] metres, in the middle of the picture
    view_deg: float = 35.0  # vertical opening angle

    @property
    def axes(self) -> NDArray[np.float64]:
        """Unit vectors ``[3, 3]``: to the right, down, and forward, in the map frame."""
        return view_axes(self.target - self.eye)

    def project(self, points: NDArray[np.float64], width: int, height: int) -> NDArray[np.float64]:
        """Column, row and inverse depth ``[N, 3]`` of points ``[N, 3]``; NaN behind the eye."""
        seen = (points - self.eye) @ self.axes.T
        depth = np.where(seen[:, 2] > _NEAR_M, seen[:, 2], np.nan)
        pixels = self._pixels_per_tangent(height)
        column = 0.5 * width + pixels * seen[:, 0] / depth
        row = 0.5 * height + pixels * seen[:, 1] / depth
        return np.column_stack([column, row, 1.0 / depth])

    def unproject(self, nearness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points ``[H, W, 3]`` of the world that the pixels of a picture show."""
        height, width = nearness.shape
        pixels = self._pixels_per_tangent(height)
        right, down, forward = self.axes
        columns = (np.arange(width) + 0.5 - 0.5 * width) / pixels
        rows = (np.arange(height) + 0.5 - 0.5 * height) / pixels
        rays = columns[None, :, None] * right + rows[:, None, None] * down + forward
        points: NDArray[np.float64] = self.eye + rays / nearness[:, :, None]
        return points

    def _pixels_per_tangent(self, height: int) -> float:
        return 0.5 * height / math.tan(0.5 * math.radians(self.view_deg))


def view_axes(forward: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors ``[3, 3]`` to the right, down and forward of a view in a direction ``[3]``."""
    forward = forward / np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def birds_eye(
    points: NDArray[np.floating],
    aspect: float,
    azimuth_deg: float = 30.0,
    elevation_deg: float = 32.0,
) -> Camera:
    """An oblique bird's-eye view that just holds points ``[N, 3]``.

    Args:
        points: metres, map frame; the outermost half percent may be cut off.
        aspect: width over height of the picture.
        azimuth_deg: of the eye, counted from the square view of the longer horizontal side.
        elevation_deg: of the eye over the horizon.
    """
    low, high = np.quantile(points[:: 1 + len(points) // 200_000], [0.005, 0.995], axis=0)
    lengthwise = high[0] - low[0] >= high[1] - low[1]
    azimuth = math.radians(azimuth_deg) + (-0.5 * math.pi if lengthwise else 0.0)
    elevation = math.radians(elevation_deg)
    flat = math.cos(elevation)
    towards_eye = np.array(
        [flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)]
    )
    middle = 0.5 * (low + high)
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    corners = np.where(picks == 1, high, low) - middle
    axes = view_axes(-towards_eye)
    right, down, forward = axes @ corners.T
    tangent = 0.97 * math.tan(0.5 * math.radians(Camera.view_deg))
    aside, beyond = _least_view(right, forward, tangent * aspect)
    below, behind = _least_view(down, forward, tangent)
    target = middle + aside * axes[0] + below * axes[1]
    return Camera(target + (max(beyond, behind) + 2.0 * _NEAR_M) * towards_eye, target)


def _least_view(
    across: NDArray[np.float64], forward: NDArray[np.float64], tangent: float
) -> tuple[float, float]:
    """Sideways shift and least distance of an eye that sees corners within a half angle.

    A corner is seen where ``|across - shift| <= tangent * (distance + forward)``.
    """
    high = float((across - tangent * forward).max())
    low = float((across + tangent * forward).min())
    return 0.5 * (high + low), 0.5 * (high - low) / tangent
