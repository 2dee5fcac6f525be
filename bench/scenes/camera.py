"""A simulated depth camera."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.simulation.lidar import SimulatedScan
from triquad_tools.simulation.scene import Scene


@dataclass(frozen=True)
class DepthCamera:
    """A pinhole camera that measures depth, with noise that grows with the depth's square.

    Its frame is the optical one: x to the right, y down, z forward. What lies beyond its depths
    gives no pixel, and no ray without a return either.
    """

    columns: int = 640
    rows: int = 480
    view_deg: float = 69.0  # horizontal
    depth_min_m: float = 0.25
    depth_max_m: float = 8.0
    noise_m: float = 0.001  # standard deviation of the depth: noise_m + noise_per_m * z**2
    noise_per_m: float = 0.0015

    @cached_property
    def directions(self) -> Doubles:
        """Vectors ``[rows * columns, 3]`` along the pixels' rays, of depth 1, row by row."""
        focal = 0.5 * self.columns / math.tan(math.radians(0.5 * self.view_deg))
        x = (np.arange(self.columns) - 0.5 * (self.columns - 1)) / focal
        y = (np.arange(self.rows) - 0.5 * (self.rows - 1)) / focal
        across, down = np.meshgrid(x, y)
        return np.stack([across, down, np.ones_like(across)], axis=-1).reshape(-1, 3)

    def scan(
        self, scene: Scene, world_from_sensor: Doubles, rng: np.random.Generator
    ) -> SimulatedScan:
        """Return one image of ``scene`` from a pose ``[4, 4]`` in its free space, as points."""
        rotation, origin = world_from_sensor[:3, :3], world_from_sensor[:3, 3]
        lengths = np.linalg.norm(self.directions, axis=1)
        rays = self.directions @ rotation.T / lengths[:, None]
        depths = scene.cast(origin, rays, self.depth_max_m * float(lengths.max())) / lengths
        seen = (depths >= self.depth_min_m) & (depths <= self.depth_max_m)
        rays, depths = rays[seen], depths[seen]
        noise_m = self.noise_m + self.noise_per_m * depths**2
        measured = depths + rng.normal(0.0, 1.0, len(depths)) * noise_m
        return SimulatedScan(
            points=(measured[:, None] * self.directions[seen]).astype(np.float32),
            true_hits=origin + (depths * lengths[seen])[:, None] * rays,
            world_from_sensor=world_from_sensor,
            no_return=np.empty((0, 3), np.float32),
        )


def looking_at(eyes: Doubles, targets: Doubles) -> Doubles:
    """Return upright poses ``[n, 4, 4]`` of a camera, from ``eyes [n, 3]`` to ``targets [n, 3]``.

    The map's z axis points up; no camera may look straight up or down.
    """
    forward = targets - eyes
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(eyes), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    poses[:, :3, 3] = eyes
    return poses
