"""An exact empty hall, and what sensors in it see."""

import numpy as np
from triquad_format.records.arrays import Doubles

LOW, HIGH = np.array([-10.0, -5, 0]), np.array([90.0, 5, 6])


def lidar_rays() -> Doubles:
    """The directions [N, 3] of a lidar of 32 beams."""
    up, around = np.radians(np.meshgrid(np.linspace(-25, 15, 32), np.arange(360) + 0.3))
    rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], -1)
    return rays.reshape(-1, 3)


def seen(rays: Doubles, pose: Doubles) -> Doubles:
    """The points [N, 3] that a sensor sees along its rays, in its frame."""
    directions = rays @ pose[:3, :3].T
    lengths = (np.where(directions > 0, HIGH, LOW) - pose[:3, 3]) / directions
    return rays * lengths.min(axis=1, keepdims=True)
