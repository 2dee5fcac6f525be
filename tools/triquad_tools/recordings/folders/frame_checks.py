"""Whether points and poses of a folder of clouds are in the frames that are said."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_file import read_points
from triquad_tools.recordings.folders.scan_folder import PlacedFile, ScanFolder
from triquad_tools.recordings.recording import with_remedies
from triquad_tools.sensors.ray_check import RayCheck
from triquad_tools.sensors.sweep import PosedScan, moved

_CLEARLY = 2.0  # times nearer to where the sensor was than to the origin, or the other way round
_APART_M, _APART_RAD = 5.0, 0.3  # that two scans are, which tell what the poses are
_COMPARED = 2_000  # points of the one, each with the nearest of ten times as many of the other
_WRONG_M = 0.1  # that they lie apart by the poses as they are, where these are wrong


def check_frame(tried: Sequence[PlacedFile], columns: Sequence[str]) -> None:
    """Check that points lie around their sensor, not around where it was in the world.

    Raises:
        ToolError: a few clouds from all over the recording lie around where it was.
    """
    if all(_lies_around_its_place(file, columns) for file in tried):
        raise ToolError(
            f"{tried[0].path.parent}: the points seem to be in the world frame: in "
            f"{tried[0].path.name} they lie around where the sensor was, not around the origin; "
            "use --points-in world, or --points-in sensor if this is wrong"
        )


def check_rays(folder: Path, scans: Iterable[PosedScan]) -> None:
    """Check that rays begin at the frame of the points.

    Raises:
        ToolError: they begin elsewhere.
    """
    rays = RayCheck()
    for scan in scans:
        rays.see(str(folder), scan.points)
    if (problem := with_remedies(rays.problem(str(folder)))) is not None:
        raise ToolError(f"{folder}: {problem}")


def _lies_around_its_place(file: PlacedFile, columns: Sequence[str]) -> bool:
    points = read_points(file.path, columns).points
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return False
    from_origin = np.median(np.linalg.norm(points, axis=1))
    from_place = np.median(np.linalg.norm(points - file.world_from_sensor[:3, 3], axis=1))
    return bool(from_place * _CLEARLY < from_origin)


def check_poses(folder: ScanFolder) -> None:
    """Check that poses take points from the sensor to the world, not the other way.

    Raises:
        ToolError: points of scans near each other agree clearly better by the inverse poses.
    """
    pairs = list(_pairs(np.array([file.world_from_sensor for file in folder.files])))
    apart_m = np.array([_apart_m(*folder.read(pair)) for pair in pairs]).reshape(-1, 2)
    as_said_m, inverse_m = np.median(apart_m, axis=0) if len(apart_m) else (0.0, 0.0)
    if as_said_m > _WRONG_M and as_said_m > _CLEARLY * inverse_m:
        raise ToolError(
            f"{folder.files[0].path.parent}: the poses seem to be sensor_from_world: points of "
            f"scans that follow each other lie {as_said_m:.2g} m apart by them, and "
            f"{inverse_m:.2g} m by their inverses: write the inverses, world_from_sensor"
        )


def _pairs(poses: Doubles) -> Iterable[tuple[int, int]]:
    """Yield a few pairs of scans, of ``poses`` [N, 4, 4]: near each other, not at one place."""
    extent_m = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
    apart_m = min(_APART_M, 0.4 * extent_m)
    for first in np.linspace(0, len(poses) - 1, 6).astype(int).tolist()[:-1]:
        between = np.linalg.inv(poses[first]) @ poses[first + 1 :]
        turns = np.arccos(np.clip((np.trace(between[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
        apart = (np.linalg.norm(between[:, :3, 3], axis=1) > apart_m) | (turns > _APART_RAD)
        if apart.any():
            yield first, first + 1 + int(apart.argmax())


def _apart_m(first: PosedScan, second: PosedScan) -> tuple[float, float]:
    """Return how far points of two scans lie apart by their poses, and by the inverses of these."""
    some, more = (
        scan.points[:: max(1, len(scan.points) // count)]
        for scan, count in ((first, _COMPARED), (second, 10 * _COMPARED))
    )
    if not len(some) or not len(more):
        return 0.0, 0.0
    poses = [first.world_from_sensor, second.world_from_sensor]
    medians = []
    for of_first, of_second in (poses, np.linalg.inv(poses)):
        tree = cKDTree(moved(more, of_second))
        medians.append(float(np.median(tree.query(moved(some, of_first))[0])))
    return medians[0], medians[1]
