"""Reads what folders in the style of KITTI have in addition to scans and ``poses.txt``.

``times.txt`` has seconds, one a line. In ``calib.txt`` the line ``Tr:`` is ``camera_from_lidar``:
the poses are then those of the camera, as KITTI gives them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.scan_folder import PlacedFile
from triquad_tools.recordings.text_lines import parse_rigid, parse_stamp, read_lines


def read_times(folder: Path, scans: int) -> list[int] | None:
    """Return the nanoseconds at which the scans of a folder were taken; None where it has no times.

    Raises:
        ToolError: a time is not a number, times run backwards, or there are not as many as scans.
    """
    path = folder / "times.txt"
    if not path.is_file():
        return None
    stamps: list[int] = []
    for place, text in read_lines(path):
        stamps.append(parse_stamp(place, text, earliest_ns=stamps[-1] if stamps else 0))
    if len(stamps) != scans:
        raise ToolError(f"{path}: {len(stamps)} times for {scans} scans")
    return stamps


def of_lidar(folder: Path, files: Sequence[PlacedFile]) -> list[PlacedFile]:
    """Return files with the poses of the lidar, by the calibration of the folder, if it has one.

    Raises:
        ToolError: the calibration is not a rigid motion.
    """
    path = folder / "calib.txt"
    if not path.is_file():
        return list(files)
    for line in read_lines(path):
        name, _, numbers = line.text.partition(":")
        if name.strip() == "Tr":
            camera_from_lidar = parse_rigid(line.place, numbers.split())
            turned = np.linalg.inv(camera_from_lidar)
            return [
                file._replace(world_from_sensor=turned @ file.world_from_sensor @ camera_from_lidar)
                for file in files
            ]
    raise ToolError(f"{path}: has no line 'Tr:'")
