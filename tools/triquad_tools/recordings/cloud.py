"""Clouds of points: those of recorded scans in the world frame, and thinner ones."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles

from triquad_tools.sensors.sweep import PosedScan, moved

_MERGED_POINTS = 2_000_000  # fewer are not worth a merge


def points_in_range(points: NDArray[np.floating], range_min_m: float) -> NDArray[np.floating]:
    """Return the points ``[N, 3]``, sensor frame, that are no nearer than a limit above 0."""
    if range_min_m <= 0.0:
        return points
    return np.asarray(points[np.linalg.norm(points, axis=1) >= range_min_m])


def world_points(scan: PosedScan, range_min_m: float = 0.0) -> Doubles:
    """Return the finite points ``[N, 3]`` of a scan that are no nearer than this, world frame."""
    points = points_in_range(scan.points, range_min_m)
    points = points[np.isfinite(points).all(axis=1)]
    return moved(points, scan.world_from_sensor)


def thin(points: Doubles, voxel_m: float) -> Doubles:
    """Return the first of points ``[N, 3]`` in each voxel of side ``voxel_m``, in their order."""
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0)
    sizes = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    return points[np.sort(np.unique(keys, return_index=True)[1])]


def merged(clouds: Iterable[Doubles], voxel_m: float) -> Doubles:
    """Return all clouds as one ``[N, 3]``, one point per voxel of side ``voxel_m``."""
    kept = [np.empty((0, 3))]  # the first is what is merged so far
    for cloud in clouds:
        kept.append(thin(cloud, voxel_m))
        if sum(map(len, kept[1:])) > max(len(kept[0]), _MERGED_POINTS):
            kept = [thin(np.concatenate(kept), voxel_m)]
    return thin(np.concatenate(kept), voxel_m)
