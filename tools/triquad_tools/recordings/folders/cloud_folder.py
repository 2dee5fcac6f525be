"""Folders of clouds, a file each, with a trajectory next to them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.file_names import in_order
from triquad_tools.recordings.folders.placed_files import (
    PlacedFile,
    PlacedFiles,
    choose_trajectory,
    look_through,
    place_files,
)
from triquad_tools.recordings.folders.point_files.file_points import FilePoints
from triquad_tools.recordings.folders.point_files.las import check_las, read_las
from triquad_tools.recordings.folders.point_files.pcd import check_pcd, read_pcd
from triquad_tools.recordings.folders.point_files.ply import check_ply, read_ply
from triquad_tools.recordings.folders.trajectory import SENSOR, WORLD, Trajectory, read_trajectory
from triquad_tools.recordings.recording import ScanEntry, Stream
from triquad_tools.sensors.errors import NoTransformError
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.point_times import offsets_s
from triquad_tools.sensors.sweep import PosedScan, Sweep, moved


class _Format(NamedTuple):
    check: Callable[[Path], int]
    read: Callable[[Path], FilePoints]


_FORMATS = {
    ".ply": _Format(check_ply, read_ply),
    ".pcd": _Format(check_pcd, read_pcd),
    ".las": _Format(check_las, read_las),
    ".laz": _Format(check_las, read_las),
}
_TRIED = 3  # clouds, to determine the frame of all
_CLEARLY = 2.0  # times nearer to where the sensor was than to the origin, or the other way round


@dataclass(frozen=True)
class CloudOptions:
    """The options for reading a folder of clouds."""

    trajectory: Path | None = None  # the file of poses; else that with a usual name
    points_in: Literal["sensor", "world"] | None = None  # their frame; else sensor, and checked
    deskew: bool = True  # take the sensor's motion out of clouds whose points have times


@dataclass(frozen=True)
class CloudFolder:
    """The clouds of a folder with their poses; points are read when asked for."""

    placed: PlacedFiles
    trajectory: Trajectory
    options: CloudOptions

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The clouds that have a pose."""
        return self.placed.entries

    @property
    def streams(self) -> Sequence[Stream]:
        """The clouds and the trajectory."""
        first = self.placed.files[0].path
        clouds = f"{first.parent.name}/*{first.suffix}"
        frame = self.options.points_in or "sensor"
        kind = first.suffix[1:].upper() + " clouds"
        poses = self.trajectory
        return [
            Stream(clouds, kind, len(self.placed.files), frame=frame, use="scans"),
            Stream(poses.path.name, poses.kind, len(poses), frame="", use="poses of the sensor"),
        ]

    @property
    def remarks(self) -> Sequence[str]:
        """The remarks on clouds without a pose, and on files that were not used."""
        return self.placed.remarks

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the finite points of the scans of these numbers."""
        for index in indices:
            yield self._scan(self.placed.files[index])

    def _scan(self, file: PlacedFile) -> PosedScan:
        points, times = _read(file.path)
        finite = np.isfinite(points).all(axis=1)
        points = points[finite]
        if self.options.points_in == "world":
            inner = moved(points, np.linalg.inv(file.world_from_sensor))
            return PosedScan(inner.astype(np.float32), file.world_from_sensor)
        single: Floats = points.astype(np.float32)
        frames = self.trajectory.frames
        if times is not None and frames is not None and self.options.deskew:
            offsets = offsets_s(times[finite], file.stamp_ns)
            try:
                return place(Sweep(single, SENSOR, file.stamp_ns, offsets), frames, WORLD)
            except NoTransformError:
                pass  # at the ends of a trajectory, where not the whole sweep has poses
        return PosedScan(single, file.world_from_sensor)


def is_cloud_folder(folder: Path) -> bool:
    """Return whether a folder, or one in it, holds files of points."""
    return folder.is_dir() and bool(_folders_of_clouds(folder))


def read_cloud_folder(folder: Path, options: CloudOptions | None = None) -> CloudFolder:
    """Return the clouds of a folder, or of the one folder in it that has some, with their poses.

    Raises:
        ToolError: there are no clouds, no trajectory or no common times, a file is damaged, or
            the clouds seem to be in another frame than it is said.
    """
    options = options or CloudOptions()
    paths = _cloud_paths(folder)
    chosen = choose_trajectory(folder, options.trajectory)
    trajectory = read_trajectory(chosen.path)
    if sum(look_through(paths, _FORMATS[paths[0].suffix.lower()].check)) == 0:
        raise ToolError(f"{paths[0].parent}: none of the {len(paths)} files holds any points")
    placed = place_files(paths, trajectory).with_remarks(chosen.remarks)
    recording = CloudFolder(placed, trajectory, options)
    if options.points_in is None:
        _check_frame(recording)
    return recording


def _folders_of_clouds(folder: Path) -> dict[Path, list[Path]]:
    """Return the files of points in a folder and in those in it."""
    folders = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    found = {
        each: in_order(path for path in each.iterdir() if path.suffix.lower() in _FORMATS)
        for each in folders
    }
    return {each: paths for each, paths in found.items() if paths}


def _cloud_paths(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ToolError(f"{folder}: no such folder")
    found = _folders_of_clouds(folder)
    if not found:
        raise ToolError(f"{folder}: holds no {', '.join(_FORMATS)}, nor does a folder in it")
    if len(found) > 1:
        folders = ", ".join(f"{each} ({len(paths)})" for each, paths in found.items())
        raise ToolError(f"{folder}: clouds lie in {folders}: leave only those that are scans")
    paths = next(iter(found.values()))
    suffixes = sorted({path.suffix for path in paths})
    if len(suffixes) > 1:
        raise ToolError(
            f"{paths[0].parent}: holds {' and '.join(suffixes)}: leave only one of them"
        )
    return paths


def _read(path: Path) -> FilePoints:
    return _FORMATS[path.suffix.lower()].read(path)


def _check_frame(recording: CloudFolder) -> None:
    """Check that points lie around their sensor, not around where it was in the world.

    Raises:
        ToolError: a few clouds from all over the recording lie around where it was.
    """
    files = recording.placed.files
    tried = [files[len(files) * (2 * step + 1) // (2 * _TRIED)] for step in range(_TRIED)]
    if all(_lies_around_its_place(file) for file in tried):
        raise ToolError(
            f"{files[0].path.parent}: the points seem to be in the world frame: in "
            f"{tried[0].path.name} they lie around where the sensor was, not around the origin; "
            "use --points-in world, or --points-in sensor if this is wrong"
        )


def _lies_around_its_place(file: PlacedFile) -> bool:
    points = _read(file.path).points
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return False
    from_origin = np.median(np.linalg.norm(points, axis=1))
    from_place = np.median(np.linalg.norm(points - file.world_from_sensor[:3, 3], axis=1))
    return bool(from_place * _CLEARLY < from_origin)
