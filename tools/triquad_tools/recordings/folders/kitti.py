"""Folders of scans in the style of KITTI odometry.

A folder holds ``poses.txt`` (12 numbers a line: a row-major 3 x 4 pose) and scans as ``*.bin``
(``float32`` x, y, z, intensity) next to it or in ``scans``, ``velodyne`` or
``velodyne_points/data``; scan ``i`` in the order of names belongs to line ``i``. It may hold
``times.txt`` (seconds, one a line) and ``calib.txt``, whose line ``Tr:`` is
``camera_from_lidar``: the poses are then those of the camera, as KITTI gives them, and are
turned into poses of the lidar.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.recording import DEFAULT_SOURCE, ScanEntry, Stream
from triquad_tools.recordings.text_lines import parse_rigid, parse_stamp, read_lines
from triquad_tools.sensors.sweep import PosedScan

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

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The entries of all scans."""
        return [ScanEntry(stamp, DEFAULT_SOURCE) for stamp in self.stamps_ns.tolist()]

    @property
    def streams(self) -> Sequence[Stream]:
        """The scans and their poses."""
        scans = self.scan_paths[0].parent.name + "/*.bin"
        return [
            Stream(scans, "KITTI scans", len(self), frame="", use="scans"),
            Stream("poses.txt", "KITTI poses", len(self), frame="", use="poses, one per scan"),
        ]

    @property
    def remarks(self) -> Sequence[str]:
        """No remarks: nothing is left out."""
        return ()

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers."""
        for index in indices:
            yield PosedScan(self.read_points(index), self.poses[index])

    def read_points(self, index: int) -> Floats:
        """Return points ``[N, 3]`` of one scan, metres, lidar frame, as the file has them."""
        path = self.scan_paths[index]
        _check_size(path)
        return np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(np.float32)


def is_kitti_folder(folder: Path) -> bool:
    """Return whether a folder holds scans as KITTI has them."""
    return any(any((folder / name).glob("*.bin")) for name in SCAN_FOLDERS)


def read_kitti_folder(folder: Path) -> KittiFolder:
    """Return the scans, poses and times of a folder.

    Raises:
        ToolError: the folder, its poses or its scans are missing, their counts differ, a scan
            is not whole, a pose or the calibration is not a rigid motion, a time is not a
            number, or times run backwards.
    """
    if not folder.is_dir():
        raise ToolError(f"{folder}: no such folder")
    if not (folder / "poses.txt").is_file():
        raise ToolError(f"{folder}: holds no poses.txt")
    scans = _scan_paths(folder)
    poses = _read_poses(folder / "poses.txt")
    _check_count(folder / "poses.txt", "poses", len(poses), scans=len(scans))
    for path in scans:
        _check_size(path)
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


def _check_size(path: Path) -> None:
    size = path.stat().st_size
    if size % _POINT_BYTES:
        raise ToolError(f"{path}: {size} bytes are not whole points of {_POINT_BYTES}")


def _read_poses(path: Path) -> Doubles:
    poses = [parse_rigid(line.place, line.words) for line in read_lines(path)]
    return np.array(poses, np.float64).reshape(-1, 4, 4)


def _read_calibration(path: Path) -> Doubles:
    for line in read_lines(path):
        name, _, numbers = line.text.partition(":")
        if name.strip() == "Tr":
            return parse_rigid(line.place, numbers.split())
    raise ToolError(f"{path}: has no line 'Tr:'")


def _read_stamps(path: Path) -> Longs:
    stamps: list[int] = []
    for place, text in read_lines(path):
        stamps.append(parse_stamp(place, text, earliest_ns=stamps[-1] if stamps else 0))
    return np.array(stamps, np.int64)
