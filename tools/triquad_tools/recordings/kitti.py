"""Folders of scans in the style of KITTI odometry.

A folder holds ``poses.txt`` (12 numbers a line: a row-major 3 x 4 pose) and scans as ``*.bin``
(``float32`` x, y, z, intensity) beside it or in ``scans``, ``velodyne`` or
``velodyne_points/data``; scan ``i`` in the order of names belongs to line ``i``. It may hold
``times.txt`` (seconds, one a line) and ``calib.txt``, whose line ``Tr:`` is
``camera_from_lidar``: the poses are then those of the camera, as KITTI gives them, and are
turned into poses of the lidar.
"""

import math
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.pose import is_rotation, orthonormal, rotation_error

from triquad_tools.console.command import ToolError

SCAN_FOLDERS = (".", "scans", "velodyne", "velodyne_points/data")
DEFAULT_PERIOD_NS = 100_000_000  # between scans of a folder without times
_POINT_BYTES = 16


@dataclass(frozen=True)
class KittiFolder:
    """The scans of a folder with their poses and times; points are read when asked for."""

    scan_paths: tuple[Path, ...]
    poses: Doubles  # [n, 4, 4] world_from_lidar, rigid
    stamps_ns: Longs  # [n]

    def __len__(self) -> int:
        return len(self.scan_paths)

    def read_points(self, index: int) -> Floats:
        """Points ``[N, 3]`` of one scan, metres, lidar frame, as the file has them."""
        path = self.scan_paths[index]
        size = path.stat().st_size
        if size % _POINT_BYTES:
            raise ToolError(f"{path}: {size} bytes are not whole points of {_POINT_BYTES}")
        return np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(np.float32)


def read_folder(folder: Path) -> KittiFolder:
    """The scans, poses and times of a folder.

    Raises:
        ToolError: the folder, its poses or its scans are missing, their counts differ, a
            pose or the calibration is not a rigid motion, a time is not a number, or times run
            backwards.
    """
    if not folder.is_dir():
        raise ToolError(f"{folder}: no such folder")
    if not (folder / "poses.txt").is_file():
        raise ToolError(f"{folder}: holds no poses.txt")
    scans = _scan_paths(folder)
    poses = _read_poses(folder / "poses.txt")
    _check_count(folder / "poses.txt", "poses", len(poses), scans=len(scans))
    calibration = folder / "calib.txt"
    if calibration.is_file():
        camera_from_lidar = _read_calibration(calibration)
        poses = np.linalg.inv(camera_from_lidar) @ poses @ camera_from_lidar
    times = folder / "times.txt"
    stamps = np.arange(len(scans), dtype=np.int64) * DEFAULT_PERIOD_NS
    if times.is_file():
        stamps = _read_stamps(times)
        _check_count(times, "times", len(stamps), scans=len(scans))
    return KittiFolder(scans, poses, stamps)


def _scan_paths(folder: Path) -> tuple[Path, ...]:
    for name in SCAN_FOLDERS:
        paths = tuple(sorted((folder / name).glob("*.bin")))
        if paths:
            return paths
    raise ToolError(f"{folder}: holds no *.bin in any of {', '.join(SCAN_FOLDERS)}")


def _check_count(path: Path, what: str, count: int, scans: int) -> None:
    if count != scans:
        raise ToolError(f"{path}: {count} {what} for {scans} scans")


def _lines(path: Path) -> list[tuple[str, str]]:
    """The lines of a file that are not blank, each with its place for messages."""
    lines = path.read_text(errors="replace").splitlines()
    return [(f"{path}:{i}", line) for i, line in enumerate(lines, start=1) if line.strip()]


def _read_poses(path: Path) -> Doubles:
    poses = [_parse_pose(place, line) for place, line in _lines(path)]
    return np.array(poses, np.float64).reshape(-1, 4, 4)


def _read_calibration(path: Path) -> Doubles:
    for place, line in _lines(path):
        name, _, numbers = line.partition(":")
        if name.strip() == "Tr":
            return _parse_pose(place, numbers)
    raise ToolError(f"{path}: has no line 'Tr:'")


def _parse_pose(place: str, line: str) -> Doubles:
    """The rigid pose ``[4, 4]`` of 12 numbers, its rotation made orthonormal."""
    words = line.split()
    if len(words) != 12:
        raise ToolError(f"{place}: {len(words)} numbers where a pose has 12")
    pose = np.eye(4)
    pose[:3] = np.reshape([_parse_number(place, word) for word in words], (3, 4))
    if not is_rotation(pose):
        raise ToolError(
            f"{place}: not a rotation: off orthonormal by {rotation_error(pose):.3g}, "
            f"determinant {np.linalg.det(pose[:3, :3]):.3g}"
        )
    return orthonormal(pose)


def _parse_number(place: str, word: str) -> float:
    try:
        number = float(word)
    except ValueError:
        raise ToolError(f"{place}: {word!r} is not a number") from None
    if not math.isfinite(number):
        raise ToolError(f"{place}: {word!r} is not finite")
    return number


def _read_stamps(path: Path) -> Longs:
    """Times in nanoseconds; decimal, for a float of seconds since 1970 is off by 100 ns."""
    stamps: list[int] = []
    for place, line in _lines(path):
        try:
            stamp = int(Decimal(line.strip()) * 10**9)
        except (InvalidOperation, ValueError, OverflowError):
            raise ToolError(f"{place}: {line.strip()!r} is not a number of seconds") from None
        if not 0 <= stamp < 2**63:
            raise ToolError(f"{place}: {line.strip()} s is out of range")
        if stamps and stamp < stamps[-1]:
            raise ToolError(f"{place}: {line.strip()} s is before the line above")
        stamps.append(stamp)
    return np.array(stamps, np.int64)
