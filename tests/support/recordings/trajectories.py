"""Poses on a path, and the files that hold them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from triquad_client.pose import Pose


def drive(
    count: int,
    step_m: float = 1.0,
    turn_rad: float = 0.05,
    start: Sequence[float] = (0.0, 0.0, 1.0),
) -> list[Pose]:
    """Poses along a bend, each a step ahead of the one before and turned a little more."""
    angles = turn_rad * np.arange(count)
    steps = step_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)
    places = np.asarray(start) + np.cumsum(steps, axis=0) - steps[0]
    return [
        Pose(place, (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))
        for place, angle in zip(places, angles, strict=True)
    ]


def matrices(poses: Sequence[Pose]) -> NDArray[np.float64]:
    return np.array([pose.matrix() for pose in poses])


def write_tum(path: Path, stamps_ns: Sequence[int], poses: Sequence[Pose]) -> Path:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, pose in zip(stamps_ns, poses, strict=True):
        numbers = [*np.asarray(pose.position_m), *np.asarray(pose.quaternion_xyzw)]
        seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
        lines.append(" ".join([seconds, *(repr(float(number)) for number in numbers)]))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_log(path: Path, poses: Sequence[Pose]) -> Path:
    """As Open3D writes it: eight digits, and the number of the frame before each pose."""
    lines = []
    for number, matrix in enumerate(matrices(poses)):
        lines.append(f"{number} {number} {number + 1}")
        lines += [" ".join(f"{value:.8f}" for value in row) for row in matrix]
    path.write_text("\n".join(lines) + "\n")
    return path
