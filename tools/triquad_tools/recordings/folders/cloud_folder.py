"""Folders of clouds, a file each, with a trajectory next to them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.arguments import SENSOR, WORLD
from triquad_tools.recordings.folders import point_file
from triquad_tools.recordings.folders.file_names import in_order, stamps_of_names
from triquad_tools.recordings.folders.frame_checks import check_frame, check_poses, check_rays
from triquad_tools.recordings.folders.scan_folder import (
    PlacedFile,
    ScanFolder,
    checked,
    place_files,
)
from triquad_tools.recordings.folders.trajectory import DEFAULT_PERIOD_NS, Trajectory
from triquad_tools.recordings.odometry import find_trajectory
from triquad_tools.recordings.recording import ReadingOptions, Stream
from triquad_tools.recordings.text_lines import parse_number, parse_stamps, read_lines, rigid
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.point_times import offsets_s
from triquad_tools.sensors.sweep import NoTransformError, PosedScan, Sweep

_DEEPER = "velodyne_points/data"  # where KITTI's raw recordings have theirs
_KITTI, _KITTI_360 = "calib.txt", "calib_cam_to_velo.txt"
_DRIVE_M, _ALONG_Z = 5.0, 0.9  # a way that tells the axes, and how much of it is along z


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
    first, above = paths[0], paths[0].parent.parent
    if first.suffix.lower() == ".bin" and options.columns is None:
        point_file.check_columns(paths)
    stamps, found = read_times([folder, above], len(paths)), None
    if options.odometry:
        stamps = (
            stamps
            or stamps_of_names(paths)
            or [number * DEFAULT_PERIOD_NS for number in range(len(paths))]
        )
        in_time = sorted(zip(stamps, paths, strict=False))
        sweeps = (_sweep(path, stamp, options) for stamp, path in in_time)
        found = find_trajectory(sweeps, len(paths), close_loops=options.loops)
    placed = place_files(folder, options, paths, stamps, found)
    columns = options.columns or point_file.KITTI_COLUMNS
    if not sum(checked(paths, partial(point_file.check_points, columns=columns))):
        raise ToolError(f"{first.parent}: none of the {len(paths)} files holds any points")
    poses, files = placed.trajectory, placed.files
    if first.suffix.lower() == ".bin" and poses.frames is None:
        files = _of_lidar([folder, above, poses.path.parent], files)
    if options.points_in is None:
        check_frame(files, columns)
    names = dict.fromkeys(path.parent.name for path in paths)
    clouds = ", ".join(f"{name}/*{first.suffix}" for name in names)
    kind = first.suffix[1:].upper() + " clouds"
    streams = (
        Stream(clouds, kind, len(files), "scans", options.points_in or SENSOR),
        Stream(poses.path.name, poses.kind, len(poses.poses), "poses of the sensor"),
    )
    read = ScanFolder(files, partial(_read_scan, poses, options), streams, placed.remarks)
    if options.ray_origin is None and options.points_in != SENSOR:
        check_rays(read)
    if options.points_in is None:
        check_poses(read)
    return read


def _sweep(path: Path, stamp_ns: int, options: ReadingOptions) -> Sweep:
    """Return the finite points of a file, with their times where there is motion to take out."""
    points, times = point_file.read_points(path, options.columns or point_file.KITTI_COLUMNS)
    finite = np.isfinite(points).all(axis=1)
    if times is None or not options.deskew:
        return Sweep(points[finite], SENSOR, stamp_ns)
    return Sweep(points[finite], SENSOR, stamp_ns, offsets_s(times[finite], stamp_ns))


def _read_scan(trajectory: Trajectory, options: ReadingOptions, file: PlacedFile) -> PosedScan:
    sweep = _sweep(file.path, file.stamp_ns, options)
    if options.points_in == WORLD:
        return PosedScan(sweep.points, np.eye(4)).seen_from(file.world_from_sensor)
    single = replace(sweep, points=sweep.points.astype(np.float32))
    if sweep.offsets_s is not None and trajectory.frames is not None:
        try:
            return place(single, trajectory.frames, WORLD)
        except NoTransformError:
            pass  # at the ends of a trajectory, where not the whole sweep has poses
    return PosedScan(single.points, file.world_from_sensor)


def _folders_of_clouds(folder: Path) -> dict[Path, list[Path]]:
    folders = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    folders += [folder / _DEEPER] if (folder / _DEEPER).is_dir() else []
    found = {
        each: in_order(
            path for path in each.iterdir() if path.suffix.lower() in point_file.POINT_SUFFIXES
        )
        for each in folders
    }
    return {each: paths for each, paths in found.items() if paths}


def _cloud_paths(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ToolError(f"{folder}: no such folder")
    found = _folders_of_clouds(folder)
    if not found:
        kinds = ", ".join(point_file.POINT_SUFFIXES)
        raise ToolError(f"{folder}: holds no {kinds}, nor does a folder in it")
    parts = list(found.values())
    spans = [(min(stamps), max(stamps)) for stamps in map(stamps_of_names, parts) if stamps]
    ordered = sorted(zip(spans, parts, strict=False))
    following = all(a[0][1] < b[0][0] for a, b in pairwise(ordered))
    if len(parts) > 1 and not (len(spans) == len(parts) and following):
        folders = ", ".join(f"{each} ({len(paths)})" for each, paths in found.items())
        raise ToolError(
            f"{folder}: clouds lie in {folders}, and not one after the other in time: leave only "
            "those that are scans, or give one of these folders, with --trajectory"
        )
    paths = [path for part in ([part for _, part in ordered] or parts) for path in part]
    suffixes = sorted({path.suffix for path in paths})
    if len(suffixes) > 1:
        kinds = " and ".join(suffixes)
        raise ToolError(f"{paths[0].parent}: holds {kinds}: leave only one of them")
    return paths


def read_times(folders: Sequence[Path], scans: int) -> list[int] | None:
    """Return the nanoseconds at which scans were taken; None where no folder says it.

    Raises:
        ToolError: a time is not a number, times run backwards, or there are not as many as scans.
    """
    path = next((each / "times.txt" for each in folders if (each / "times.txt").is_file()), None)
    if path is None:
        return None
    stamps = parse_stamps(read_lines(path))
    if len(stamps) != scans:
        raise ToolError(f"{path}: {len(stamps)} times for {scans} scans")
    return stamps


def _of_lidar(folders: Sequence[Path], files: Sequence[PlacedFile]) -> list[PlacedFile]:
    """Return files with the poses of the lidar, by the calibration in one of the folders, if any.

    In ``calib.txt`` the line ``Tr:`` is ``camera_from_lidar``: the poses are then those of the
    camera, as KITTI gives them. ``calib_cam_to_velo.txt`` of KITTI-360 is ``lidar_from_camera``.
    """
    of_camera = (each / name for each in folders for name in (_KITTI, _KITTI_360))
    path = next((each for each in of_camera if each.is_file()), None)
    if path is None:
        _check_axes(folders[0], files)
        return list(files)
    is_360 = path.name == _KITTI_360
    for line in read_lines(path):
        name, _, numbers = line.text.rpartition(":")
        if is_360 or name.strip() == "Tr":
            given = rigid(line.place, [parse_number(line.place, word) for word in numbers.split()])
            inverse = np.linalg.inv(given)
            # KITTI's world lies as the first camera does; that of KITTI-360 has z up.
            world, of_lidar = (np.eye(4), inverse) if is_360 else (inverse, given)
            return [
                file._replace(world_from_sensor=world @ file.world_from_sensor @ of_lidar)
                for file in files
            ]
    raise ToolError(f"{path}: has no line 'Tr:'")


def _check_axes(folder: Path, files: Sequence[PlacedFile]) -> None:
    """Check that a lidar drives along its x or y, not along z as a camera does."""
    poses = np.array([file.world_from_sensor for file in files])
    steps = np.diff(poses[:, :3, 3], axis=0)
    ahead = np.abs(np.einsum("nij,ni->nj", poses[:-1, :3, :3], steps))  # in the sensor's frame
    length = np.linalg.norm(steps, axis=1).sum()
    if length > _DRIVE_M and ahead[:, 2].sum() > _ALONG_Z * length:
        raise ToolError(
            f"{folder}: by its poses the lidar drives along its z, as a camera does, and there is "
            f"no {_KITTI} with a line 'Tr:': put that of the sequence there, or one with "
            "'Tr: 1 0 0 0 0 1 0 0 0 0 1 0' if the poses are those of the lidar"
        )
