"""Folders of scans in the style of KITTI odometry.

A folder holds ``poses.txt`` (12 numbers a line: a row-major 3 x 4 pose) and scans as ``*.bin``
(``float32`` x, y, z, intensity) next to it or in ``scans``, ``velodyne`` or
``velodyne_points/data``; scan ``i``, by the numbers in the names, belongs to line ``i``. It may
hold ``times.txt`` (seconds, one a line) and ``calib.txt``, whose line ``Tr:`` is
``camera_from_lidar``: the poses are then those of the camera, as KITTI gives them, and are
turned into poses of the lidar.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.file_names import in_order
from triquad_tools.recordings.folders.scan_folder import PlacedFile, ScanFolder
from triquad_tools.recordings.folders.trajectory import DEFAULT_PERIOD_NS
from triquad_tools.recordings.recording import Stream
from triquad_tools.recordings.text_lines import parse_rigid, parse_stamp, read_lines
from triquad_tools.sensors.sweep import PosedScan

SCAN_FOLDERS = (".", "scans", "velodyne", "velodyne_points/data")
_POINT_BYTES = 16


def is_kitti_folder(folder: Path) -> bool:
    """Return whether a folder holds scans as KITTI has them."""
    return any(any((folder / name).glob("*.bin")) for name in SCAN_FOLDERS)


def read_kitti_folder(folder: Path) -> ScanFolder:
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
    poses = _read_poses(folder)
    _check_count(folder / "poses.txt", "poses", poses, scans)
    for path in scans:
        _check_size(path)
    stamps = [index * DEFAULT_PERIOD_NS for index in range(len(scans))]
    if (folder / "times.txt").is_file():
        stamps = _read_stamps(folder / "times.txt")
        _check_count(folder / "times.txt", "times", stamps, scans)
    files = [PlacedFile(*each) for each in zip(scans, stamps, poses, strict=True)]
    streams = (
        Stream(f"{scans[0].parent.name}/*.bin", "KITTI scans", len(scans), "scans"),
        Stream("poses.txt", "KITTI poses", len(scans), "poses, one per scan"),
    )
    return ScanFolder(files, _read_scan, streams)


def _read_scan(file: PlacedFile) -> PosedScan:
    """Return points ``[N, 3]`` of one scan, metres, lidar frame, as the file has them."""
    _check_size(file.path)
    points = np.fromfile(file.path, "<f4").reshape(-1, 4)[:, :3].astype(np.float32)
    return PosedScan(points, file.world_from_sensor)


def _scan_paths(folder: Path) -> list[Path]:
    for name in SCAN_FOLDERS:
        if paths := in_order((folder / name).glob("*.bin")):
            return paths
    raise ToolError(f"{folder}: holds no *.bin in any of {', '.join(SCAN_FOLDERS)}")


def _check_count(
    path: Path, what: str, found: Sequence[int] | Doubles, scans: Sequence[Path]
) -> None:
    if len(found) != len(scans):
        raise ToolError(f"{path}: {len(found)} {what} for {len(scans)} scans")


def _check_size(path: Path) -> None:
    size = path.stat().st_size
    if size % _POINT_BYTES:
        raise ToolError(f"{path}: {size} bytes are not whole points of {_POINT_BYTES}")


def _read_poses(folder: Path) -> Doubles:
    """Return poses [n, 4, 4] of the lidar."""
    lines = read_lines(folder / "poses.txt")
    poses = np.array([parse_rigid(line.place, line.words) for line in lines]).reshape(-1, 4, 4)
    calibration = folder / "calib.txt"
    if not calibration.is_file():
        return poses
    for line in read_lines(calibration):
        name, _, numbers = line.text.partition(":")
        if name.strip() == "Tr":
            camera_from_lidar = parse_rigid(line.place, numbers.split())
            return np.asarray(np.linalg.inv(camera_from_lidar) @ poses @ camera_from_lidar)
    raise ToolError(f"{calibration}: has no line 'Tr:'")


def _read_stamps(path: Path) -> list[int]:
    stamps: list[int] = []
    for place, text in read_lines(path):
        stamps.append(parse_stamp(place, text, earliest_ns=stamps[-1] if stamps else 0))
    return stamps
