"""Folders of clouds, a file each, with a trajectory next to them."""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from triquad_format.records.arrays import Floats

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_file import POINT_SUFFIXES, check_points, read_points
from triquad_tools.recordings.folders.scan_folder import (
    PlacedFile,
    ScanFolder,
    check_all,
    in_order,
    place_files,
)
from triquad_tools.recordings.folders.trajectory import Trajectory
from triquad_tools.recordings.recording import (
    ORIGIN_REMEDIES,
    SENSOR,
    WORLD,
    ReadingOptions,
    Stream,
)
from triquad_tools.recordings.text_lines import parse_rigid, parse_stamps, read_lines
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.point_times import offsets_s
from triquad_tools.sensors.ray_check import RayCheck
from triquad_tools.sensors.sweep import NoTransformError, PosedScan, Sweep, moved

_TRIED = 4  # clouds, to determine the frame of all
_CLEARLY = 2.0  # times nearer to where the sensor was than to the origin, or the other way round

_DEEPER = "velodyne_points/data"  # where KITTI's raw recordings have theirs


def is_cloud_folder(folder: Path) -> bool:
    """Return whether a folder, or one in it, holds files of points."""
    return folder.is_dir() and bool(_folders_of_clouds(folder))


def read_cloud_folder(folder: Path, options: ReadingOptions | None = None) -> ScanFolder:
    """Return the clouds of a folder, or of the one folder in it that has some, with their poses.

    Raises:
        ToolError: there are no clouds, no trajectory or no common times, a file is damaged, or
            the clouds seem to be in another frame than it is said.
    """
    options = options or ReadingOptions()
    paths = _cloud_paths(folder)
    placed = place_files(folder, options.trajectory, paths, read_times(folder, len(paths)))
    if not sum(check_all(paths, check_points)):
        raise ToolError(f"{paths[0].parent}: none of the {len(paths)} files holds any points")
    first, poses, files = paths[0], placed.trajectory, placed.files
    if first.suffix == ".bin" and poses.frames is None:
        files = of_lidar(folder, files)
    tried = [files[len(files) * (2 * step + 1) // (2 * _TRIED)] for step in range(_TRIED)]
    if options.points_in is None:
        _check_frame(tried)
    read_file = partial(_read_scan, poses, options)
    if options.ray_origin is None:
        _check_rays(first.parent, map(read_file, tried))
    clouds, kind = f"{first.parent.name}/*{first.suffix}", first.suffix[1:].upper() + " clouds"
    streams = (
        Stream(clouds, kind, len(files), "scans", options.points_in or SENSOR),
        Stream(poses.path.name, poses.kind, len(poses.poses), "poses of the sensor"),
    )
    return ScanFolder(files, read_file, streams, placed.remarks)


def _read_scan(trajectory: Trajectory, options: ReadingOptions, file: PlacedFile) -> PosedScan:
    """Return the finite points of a cloud, in the frame of the sensor."""
    points, times = read_points(file.path)
    finite = np.isfinite(points).all(axis=1)
    points = points[finite]
    if options.points_in == WORLD:
        inner = moved(points, np.linalg.inv(file.world_from_sensor))
        return PosedScan(inner.astype(np.float32), file.world_from_sensor)
    single: Floats = points.astype(np.float32)
    if times is not None and trajectory.frames is not None and options.deskew:
        offsets = offsets_s(times[finite], file.stamp_ns)
        try:
            return place(Sweep(single, SENSOR, file.stamp_ns, offsets), trajectory.frames, WORLD)
        except NoTransformError:
            pass  # at the ends of a trajectory, where not the whole sweep has poses
    return PosedScan(single, file.world_from_sensor)


def _folders_of_clouds(folder: Path) -> dict[Path, list[Path]]:
    """Return the files of points in a folder and in those in it."""
    folders = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    folders += [folder / _DEEPER] if (folder / _DEEPER).is_dir() else []
    found = {
        each: in_order(path for path in each.iterdir() if path.suffix.lower() in POINT_SUFFIXES)
        for each in folders
    }
    return {each: paths for each, paths in found.items() if paths}


def _cloud_paths(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ToolError(f"{folder}: no such folder")
    found = _folders_of_clouds(folder)
    if not found:
        raise ToolError(f"{folder}: holds no {', '.join(POINT_SUFFIXES)}, nor does a folder in it")
    if len(found) > 1:
        folders = ", ".join(f"{each} ({len(paths)})" for each, paths in found.items())
        raise ToolError(f"{folder}: clouds lie in {folders}: leave only those that are scans")
    (paths,) = found.values()
    suffixes = sorted({path.suffix for path in paths})
    if len(suffixes) > 1:
        raise ToolError(
            f"{paths[0].parent}: holds {' and '.join(suffixes)}: leave only one of them"
        )
    return paths


def _check_frame(tried: Sequence[PlacedFile]) -> None:
    """Check that points lie around their sensor, not around where it was in the world.

    Raises:
        ToolError: a few clouds from all over the recording lie around where it was.
    """
    if all(map(_lies_around_its_place, tried)):
        raise ToolError(
            f"{tried[0].path.parent}: the points seem to be in the world frame: in "
            f"{tried[0].path.name} they lie around where the sensor was, not around the origin; "
            "use --points-in world, or --points-in sensor if this is wrong"
        )


def _check_rays(folder: Path, scans: Iterable[PosedScan]) -> None:
    """Check that rays begin at the frame of the points.

    Raises:
        ToolError: they begin elsewhere.
    """
    rays = RayCheck()
    for scan in scans:
        rays.see(str(folder), scan.points)
    problem = rays.begin_elsewhere(str(folder))
    if problem is not None:
        raise ToolError(f"{folder}: {problem}: {ORIGIN_REMEDIES}")


def _lies_around_its_place(file: PlacedFile) -> bool:
    points = read_points(file.path).points
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return False
    from_origin = np.median(np.linalg.norm(points, axis=1))
    from_place = np.median(np.linalg.norm(points - file.world_from_sensor[:3, 3], axis=1))
    return bool(from_place * _CLEARLY < from_origin)


def read_times(folder: Path, scans: int) -> list[int] | None:
    """Return the nanoseconds at which the scans of a folder were taken; None where it has no times.

    Raises:
        ToolError: a time is not a number, times run backwards, or there are not as many as scans.
    """
    path = folder / "times.txt"
    if not path.is_file():
        return None
    stamps = parse_stamps(read_lines(path))
    if len(stamps) != scans:
        raise ToolError(f"{path}: {len(stamps)} times for {scans} scans")
    return stamps


def of_lidar(folder: Path, files: Sequence[PlacedFile]) -> list[PlacedFile]:
    """Return files with the poses of the lidar, by the calibration of the folder, if it has one.

    In ``calib.txt`` the line ``Tr:`` is ``camera_from_lidar``: the poses are then those of the
    camera, as KITTI gives them.

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
