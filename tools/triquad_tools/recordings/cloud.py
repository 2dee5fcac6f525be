"""Points of recorded scans in the world frame."""

import numpy as np
from numpy.typing import NDArray

from triquad_tools.recordings.kitti import KittiFolder


def is_withheld(index: int, every: int) -> bool:
    """Whether scan ``index`` is kept back for testing: the last of each ``every`` scans."""
    return every > 0 and index % every == every - 1


def points_in_range(
    points: NDArray[np.float32], range_min_m: float, range_max_m: float = np.inf
) -> NDArray[np.float32]:
    """The points ``[N, 3]``, sensor frame, whose ranges lie within both limits.

    Points that are not finite are left out as soon as a limit is given.
    """
    if range_min_m <= 0.0 and not np.isfinite(range_max_m):
        return points
    ranges = np.linalg.norm(points, axis=1)
    kept: NDArray[np.float32] = points[(ranges >= range_min_m) & (ranges <= range_max_m)]
    return kept


def world_points(
    folder: KittiFolder, index: int, range_min_m: float = 0.0, range_max_m: float = np.inf
) -> NDArray[np.float64]:
    """The finite points ``[N, 3]`` of one scan within limits of the range, world frame."""
    points = points_in_range(folder.read_points(index), range_min_m, range_max_m)
    points = points[np.isfinite(points).all(axis=1)]
    pose = folder.poses[index]
    world: NDArray[np.float64] = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    return world
