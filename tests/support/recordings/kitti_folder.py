"""Folders of scans in the style of KITTI odometry, written."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_folder(
    folder: Path,
    scans: Sequence[NDArray[np.float32]],
    poses: NDArray[np.float64],
    stamps_ns: Sequence[int] | NDArray[np.int64],
) -> None:
    """Write scans as a folder of KITTI, which a recording is read back from unchanged.

    Args:
        folder: made where it is missing.
        scans: per scan points ``[N, 3]``, metres, lidar frame.
        poses: ``[n, 4, 4]`` world_from_lidar.
        stamps_ns: ``[n]`` nanoseconds.
    """
    (folder / "scans").mkdir(parents=True, exist_ok=True)
    for index, points in enumerate(scans):
        rows = np.zeros((len(points), 4), "<f4")
        rows[:, :3] = points
        rows.tofile(folder / "scans" / f"{index:06d}.bin")
    lines = (" ".join(repr(float(x)) for x in pose[:3].reshape(-1)) for pose in poses)
    (folder / "poses.txt").write_text("".join(f"{line}\n" for line in lines))
    times = (f"{int(ns) // 10**9}.{int(ns) % 10**9:09d}\n" for ns in stamps_ns)
    (folder / "times.txt").write_text("".join(times))
