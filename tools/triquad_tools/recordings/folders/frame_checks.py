"""Whether points and poses of a folder of clouds are in the frames that are said."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_file import read_points
from triquad_tools.recordings.folders.scan_folder import PlacedFile, ScanFolder
from triquad_tools.recordings.recording import with_remedies
from triquad_tools.sensors.ray_check import RayCheck
from triquad_tools.sensors.sweep import PosedScan, moved

_TRIED = 4  # clouds, to determine the frame of all
_CLEARLY = 2.0  # times nearer to where the sensor was than to the origin, or the other way round
_APART_M, _APART_RAD = 5.0, 0.3  # that two scans are, which tell what the poses are
_COMPARED = 2_000  # points of the one, each with the nearest of ten times as many of the other
_WRONG_M = 0.1  # that they lie apart by the poses as they are, where these are wrong


def check_frame(files: Sequence[PlacedFile], columns: Sequence[str]) -> None:
    """Check that points lie around their sensor, not around where it was in the world.

    Raises:
        ToolError: a few clouds from all over the recording lie around where it was.
    """
    tried = some_of(files)
    if all(_lies_around_its_place(file, columns) for file in tried):
        raise ToolError(
            f"{tried[0].path.parent}: the points seem to be in the world frame: in "
            f"{tried[0].path.name} they lie around where the sensor was, not around the origin; "
            "use --points-in world, or --points-in sensor if this is wrong"
        )


def check_rays(folder: ScanFolder, *, is_depth: bool = False) -> None:
    """Check that rays begin at the frame of the points, and that these and poses are in metres.

    Raises:
        ToolError: a few scans tell that they do not, or are not.
    """
    rays, where = RayCheck(), folder.files[0].path.parent
    for file in some_of(folder.files):
        rays.see(str(where), folder.read_file(file).points, is_depth=is_depth)
    places = np.array([file.world_from_sensor[:3, 3] for file in folder.files])
    if (problem := with_remedies(rays.problem(str(where), places))) is not None:
        raise ToolError(f"{where}: {problem}")


def some_of(files: Sequence[PlacedFile]) -> list[PlacedFile]:
    """Return a few files from all over a recording."""
    return [files[len(files) * (2 * step + 1) // (2 * _TRIED)] for step in range(_TRIED)]


def _lies_around_its_place(file: PlacedFile, columns: Sequence[str]) -> bool:
    points = read_points(file.path, columns).points
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return False
    from_origin = np.median(np.linalg.norm(points, axis=1))
    from_place = np.median(np.linalg.norm(points - file.world_from_sensor[:3, 3], axis=1))
    return bool(from_place * _CLEARLY < from_origin)


def check_poses(folder: ScanFolder) -> None:
    """Check that of the readings of the poses none fits the points better than theirs.

    Raises:
        ToolError: points of scans near each other agree clearly better by another one.
    """
    pairs = list(_pairs(np.array([file.world_from_sensor for file in folder.files])))
    apart_m = [_apart_m(*folder.read(pair)) for pair in pairs]
    as_said_m, *others_m = np.mean(apart_m or [[0.0] * (1 + len(_READINGS))], axis=0).tolist()
    other_m, (other, remedy) = min(zip(others_m, _READINGS, strict=True))
    if as_said_m > _WRONG_M and as_said_m > _CLEARLY * other_m:
        raise ToolError(
            f"{folder.files[0].path.parent}: the poses seem to {other}: points of scans that "
            f"follow each other lie {as_said_m:.2g} m apart by them, and {other_m:.2g} m if they "
            f"are taken so: {remedy}"
        )


def _reordered(shift: int, poses: Doubles) -> Doubles:
    """Return poses [N, 4, 4] whose quaternions have w at their other end."""
    turns, poses = Rotation.from_matrix(poses[:, :3, :3]).as_quat(), poses.copy()
    poses[:, :3, :3] = Rotation.from_quat(np.roll(turns, shift, axis=1)).as_matrix()
    return poses


_READINGS: dict[tuple[str, str], Callable[..., Doubles]] = {
    ("be sensor_from_world", "write the inverses, world_from_sensor"): np.linalg.inv,
    ("have quaternions w x y z", "use --quaternion wxyz"): partial(_reordered, -1),
    ("have quaternions x y z w", "use --quaternion xyzw"): partial(_reordered, 1),
}
"""How else poses may be meant, what to do then, and the poses as they are meant."""


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


def _apart_m(first: PosedScan, second: PosedScan) -> list[float]:
    """Return how far points of two scans lie apart by their poses, and by other readings."""
    some, more = (
        scan.points[:: max(1, len(scan.points) // count)]
        for scan, count in ((first, _COMPARED), (second, 10 * _COMPARED))
    )
    if not len(some) or not len(more):
        return [0.0] * (1 + len(_READINGS))
    poses = np.array([first.world_from_sensor, second.world_from_sensor])
    medians = []
    for of_first, of_second in (poses, *(read(poses) for read in _READINGS.values())):
        tree = cKDTree(moved(more, of_second))
        medians.append(float(np.median(tree.query(moved(some, of_first))[0])))
    return medians
