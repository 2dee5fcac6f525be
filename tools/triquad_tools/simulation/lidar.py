"""A simulated spinning lidar that drives through an exact scene."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles, Floats

from triquad_tools.recordings.cloud import merged
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.scene import Scene

_SENSOR_HEIGHT_M = 1.8
_LANE_M = 1.6  # lateral offset of the lane from the middle of the road
_WEAVE_M = 0.3
_TILT_RAD = math.radians(1.0)  # of the gentle roll and pitch


@dataclass(frozen=True)
class SimulatedScan(PosedScan):
    """The sensor's measurements: returns with range noise, and the truth behind each."""

    true_hits: Doubles  # [N, 3] metres, world frame, exactly on the surface
    no_return: Floats = field(kw_only=True)  # [M, 3] unit vectors of rays that met nothing


@dataclass(frozen=True)
class Lidar:
    """A spinning lidar: ``beams`` rows of ``columns`` rays each, with Gaussian range noise.

    All rays of a scan leave from one pose: the scan is as if already corrected for the motion
    during the sweep.
    """

    beams: int = 64
    columns: int = 720
    elevation_min_deg: float = -25.0
    elevation_max_deg: float = 15.0
    range_min_m: float = 0.5
    range_max_m: float = 50.0
    noise_m: float = 0.01  # standard deviation of the range

    @cached_property
    def directions(self) -> Doubles:
        """Unit vectors ``[beams * columns, 3]`` of the rays, sensor frame, column by column."""
        low, high = math.radians(self.elevation_min_deg), math.radians(self.elevation_max_deg)
        azimuth = np.arange(self.columns) * (2.0 * math.pi / self.columns)
        azimuth, elevation = np.meshgrid(azimuth, np.linspace(low, high, self.beams), indexing="ij")
        flat = np.cos(elevation)
        rays = (flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation))
        return np.stack(rays, axis=-1).reshape(-1, 3)

    def scan(
        self, scene: Scene, world_from_sensor: Doubles, rng: np.random.Generator
    ) -> SimulatedScan:
        """Return one scan of ``scene`` from a pose ``[4, 4]`` in its free space."""
        rotation, origin = world_from_sensor[:3, :3], world_from_sensor[:3, 3]
        rays = self.directions @ rotation.T
        ranges = scene.cast(origin, rays, self.range_max_m)
        seen = np.isfinite(ranges) & (ranges >= self.range_min_m)
        missed = np.isinf(ranges)
        ranges = ranges[seen]
        measured = ranges + rng.normal(0.0, self.noise_m, len(ranges))
        return SimulatedScan(
            points=(measured[:, None] * self.directions[seen]).astype(np.float32),
            true_hits=origin + ranges[:, None] * rays[seen],
            world_from_sensor=world_from_sensor,
            no_return=self.directions[missed].astype(np.float32),
        )


class Sensor(Protocol):
    """A simulated sensor."""

    def scan(
        self, scene: Scene, world_from_sensor: Doubles, rng: np.random.Generator
    ) -> SimulatedScan:
        """Return one scan of ``scene`` from a pose ``[4, 4]`` in its free space."""


@dataclass(frozen=True)
class SimulatedDrive:
    """A sequence of scans along a drive. Each scan is made when asked for, always the same."""

    scene: Scene
    sensor: Sensor
    poses: Doubles  # [n, 4, 4] world_from_sensor
    seed: int = 0

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[SimulatedScan]:
        return (self.scan(index) for index in range(len(self)))

    def scan(self, index: int) -> SimulatedScan:
        """Return scan ``index`` of the drive."""
        rng = np.random.default_rng([self.seed, index])
        return self.sensor.scan(self.scene, self.poses[index], rng)

    def true_hits(self, voxel_m: float = 0.02) -> Doubles:
        """Return what the sensor could have seen: exact surface points ``[N, 3]``, world frame."""
        return merged((scan.true_hits for scan in self), voxel_m)


def drive(scene: Scene, n_scans: int, step_m: float) -> Doubles:
    """Return poses ``world_from_sensor [n_scans, 4, 4]`` of a drive along a street.

    The sensor starts at ``x = 0``, 1.8 m above the road, in the lane at ``y < 0``, weaving gently
    and rolling and pitching by about a degree. At the end of the road it turns and comes back in
    the other lane, and so on for as long as there are scans to make.
    """
    travelled = np.arange(n_scans, dtype=np.float64) * step_m
    positions = _positions(travelled, scene.drive_length_m)
    ahead = _positions(travelled + 0.05, scene.drive_length_m) - positions
    return poses_along(travelled, positions, np.arctan2(ahead[:, 1], ahead[:, 0]))


def poses_along(travelled: Doubles, positions: Doubles, yaw: Doubles) -> Doubles:
    """Return poses ``[n, 4, 4]`` at positions ``[n, 3]`` and headings ``[n]``, radians.

    They roll and pitch by about a degree with the way ``[n]`` that was travelled.
    """
    roll = _TILT_RAD * np.sin(travelled * 0.31)
    pitch = _TILT_RAD * np.sin(travelled * 0.23 + 1.0)
    poses = np.tile(np.eye(4), (len(travelled), 1, 1))
    # Roll about x, then pitch about y, then yaw about z.
    angles = np.column_stack([roll, pitch, yaw])
    poses[:, :3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    poses[:, :3, 3] = positions
    return poses


def _positions(travelled: Doubles, length_m: float) -> Doubles:
    """Return positions ``[n, 3]`` on a stadium of two lanes joined by half circles."""
    turn = math.pi * _LANE_M
    lap = travelled % (2.0 * (length_m + turn))
    back = lap >= length_m + turn
    along = np.where(back, lap - length_m - turn, lap)
    angle = np.maximum(along - length_m, 0.0) / _LANE_M
    lane = _LANE_M + _WEAVE_M * np.sin(travelled * 0.17)
    x = np.minimum(along, length_m) + lane * np.sin(angle)
    y = -lane * np.cos(angle)
    height = np.full(len(travelled), _SENSOR_HEIGHT_M)
    return np.column_stack([np.where(back, length_m - x, x), np.where(back, -y, y), height])
