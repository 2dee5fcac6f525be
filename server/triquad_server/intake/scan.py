"""Checking scans at the edge: what is refused, and which points are used."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Longs
from triquad_format.records.pose import is_rigid, rotation_error
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import empty_keys, enter

from triquad_server.settings import ScanSettings

WORLD_LIMIT_M = 100_000.0
"""A sensor farther than this from the map's origin is refused."""


class ScanRefusedError(Exception):
    """A scan that cannot be used; ``reason`` is the short key under which it is counted."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True)
class ScanRays:
    """The usable rays of a scan, in the map frame, metres."""

    origin: NDArray[np.float64]  # [3] the sensor
    ends: NDArray[np.float64]  # [N, 3]
    points_dropped: dict[str, int]  # points of the scan that are not used, by reason


def check_pose(world_from_sensor: NDArray[np.float64]) -> None:
    """Refuse a pose [4, 4] that is not finite, not rigid or outside the world."""
    pose = world_from_sensor
    if pose.shape != (4, 4):
        raise ScanRefusedError("pose_shape", f"the pose is {list(pose.shape)}, not [4, 4]")
    if not np.isfinite(pose).all():
        raise ScanRefusedError(
            "pose_not_finite", f"the pose has values that are not finite: {pose}"
        )
    if not is_rigid(pose):
        raise ScanRefusedError(
            "pose_not_rigid",
            f"the pose is not a rotation and a translation (rotation off by "
            f"{rotation_error(pose):.2g}, last row {pose[3]}); scale and shear are not allowed",
        )
    far = float(np.abs(pose[:3, 3]).max())
    if far > WORLD_LIMIT_M:
        raise ScanRefusedError(
            "outside_world",
            f"the sensor is {far:.0f} m from the map's origin, more than {WORLD_LIMIT_M:.0f} m; "
            "subtract an offset from the poses",
        )


def _check_points(points: NDArray[np.float32], max_points: int) -> None:
    """Refuse points that are not [N, 3], or more than ``max_points``."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise ScanRefusedError("points_shape", f"points are {list(points.shape)}, not [N, 3]")
    if len(points) > max_points:
        raise ScanRefusedError(
            "too_many_points",
            f"{len(points)} points exceed scan.max_points = {max_points}",
        )


@kernel()
def _select(
    points: NDArray[np.float32],
    range_min_m: float,
    range_max_m: float,
    thin_m: float,
    keys: Longs,
) -> tuple[NDArray[np.float64], int, int, int]:
    """The points that are used; how many are not finite, too near and too far."""
    kept = np.empty((len(points), 3))
    count = not_finite = too_near = too_far = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        distance = np.sqrt(x * x + y * y + z * z)
        if not np.isfinite(distance):
            not_finite += 1
        elif distance < range_min_m or distance == 0:  # which is "no return" to many sensors
            too_near += 1
        elif distance > range_max_m:
            too_far += 1
        elif enter(keys, x, y, z, thin_m):
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            count += 1
    return kept[:count], not_finite, too_near, too_far


def usable_rays(
    points: NDArray[np.float32],
    world_from_sensor: NDArray[np.float64],
    settings: ScanSettings,
) -> ScanRays:
    """The rays of a scan that are finite, in range and thinned.

    Args:
        points: end points [N, 3], metres, sensor frame.
        world_from_sensor: pose [4, 4].
        settings: ranges and thinning.

    Raises:
        ScanRefusedError: the pose is bad, or no point can be used.
    """
    check_pose(world_from_sensor)
    _check_points(points, settings.max_points)
    kept, not_finite, too_near, too_far = _select(
        np.ascontiguousarray(points),
        settings.range_min_m,
        settings.range_max_m,
        settings.thin_m,
        empty_keys(len(points)),
    )
    dropped = {"not_finite": not_finite, "too_near": too_near, "too_far": too_far}
    if len(kept) == 0:
        raise ScanRefusedError(
            "empty",
            f"none of {len(points)} points is finite and between {settings.range_min_m} m and "
            f"{settings.range_max_m} m from the sensor",
        )
    rotation, origin = world_from_sensor[:3, :3], world_from_sensor[:3, 3]
    counts = {reason: count for reason, count in dropped.items() if count}
    return ScanRays(origin.copy(), kept @ rotation.T + origin, counts)
