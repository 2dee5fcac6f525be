"""A lidar that moves while it turns: each column of a sweep is measured from another pose."""

import math
from dataclasses import dataclass

import numpy as np
from triquad_client.pose import Pose
from triquad_format.records.arrays import Doubles
from triquad_tools.sensors.motion.frame_tree import FrameTree, Transform
from triquad_tools.sensors.sweep import Sweep
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene

SWEEP_S = 0.1  # of a lidar that turns at 10 Hz
WORLD, SENSOR = "odom", "lidar"
_POSE_PERIOD_S = 0.01


@dataclass(frozen=True)
class SteadyMotion:
    """Motion along x at a constant speed, while the sensor turns about the vertical."""

    start_m: tuple[float, float, float]
    speed_m_s: float
    yaw_rate_rad_s: float

    def pose(self, time_s: float) -> Pose:
        """Return where the sensor is."""
        half = 0.5 * self.yaw_rate_rad_s * time_s
        x, y, z = self.start_m
        return Pose((x + self.speed_m_s * time_s, y, z), (0, 0, math.sin(half), math.cos(half)))

    def frames(self, end_s: float) -> FrameTree:
        """Return the motion up to a time as a robot reports it, a hundred times a second."""
        frames = FrameTree()
        for number in range(-1, round((end_s + SWEEP_S) / _POSE_PERIOD_S) + 2):
            time_s = number * _POSE_PERIOD_S
            frames.add(Transform(WORLD, SENSOR, nanoseconds(time_s), self.pose(time_s)))
        return frames


def nanoseconds(time_s: float) -> int:
    """Return a time as a stamp."""
    return round(time_s * 1e9)


def sweep(
    scene: Scene, lidar: Lidar, motion: SteadyMotion, *, start_s: float, rng: np.random.Generator
) -> Sweep:
    """Return one turn of a lidar that begins at a time; each point has its own."""
    columns = lidar.directions.reshape(lidar.columns, lidar.beams, 3)
    parts: list[Doubles] = []
    offsets: list[Doubles] = []
    for number, rays in enumerate(columns):
        offset_s = SWEEP_S * number / lidar.columns
        pose = motion.pose(start_s + offset_s).matrix()
        ranges = scene.cast(pose[:3, 3], rays @ pose[:3, :3].T, lidar.range_max_m)
        seen = np.isfinite(ranges) & (ranges >= lidar.range_min_m)
        measured = ranges[seen] + rng.normal(0.0, lidar.noise_m, seen.sum())
        parts.append(measured[:, None] * rays[seen])
        offsets.append(np.full(len(measured), offset_s))
    points = np.concatenate(parts).astype(np.float32)
    return Sweep(points, SENSOR, nanoseconds(start_s), np.concatenate(offsets))
