"""Whether points and poses of a folder of clouds are in the frames that are said."""

from collections.abc import Iterable, Sequence

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.plausibility import are_apart, misreading, shares_before, view_of

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_file import read_points
from triquad_tools.recordings.folders.scan_folder import PlacedFile, ScanFolder
from triquad_tools.recordings.recording import with_remedies
from triquad_tools.sensors.ray_check import RayCheck

_TRIED = 4  # clouds, to determine the frame of all
_CLEARLY = 2.0  # times nearer to where the sensor was than to the origin, or the other way round
_APART_M, _APART_RAD = 5.0, 0.3  # that two scans are, which tell what the poses are
_REMEDIES = {
    "inverse": "write the inverses, world_from_sensor",
    "wxyz": "use --quaternion wxyz",
    "xyzw": "use --quaternion xyzw",
    "unmoved": "use --points-in world; if they are not, write rotations of radians, not degrees",
}


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
    views = [
        [view_of(scan.points, scan.world_from_sensor) for scan in folder.read(pair)]
        for pair in _pairs(np.array([file.world_from_sensor for file in folder.files]))
    ]
    shares = [found for pair in views if (found := shares_before(*pair)) is not None]
    reading, told = misreading(shares) or ("", "")
    if reading in _REMEDIES:
        raise ToolError(f"{folder.files[0].path.parent}: {told}: {_REMEDIES[reading]}")


def _pairs(poses: Doubles) -> Iterable[tuple[int, int]]:
    """Yield a few pairs of scans, of ``poses`` [N, 4, 4]: near each other, not at one place."""
    extent_m = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
    apart_m = min(_APART_M, 0.4 * extent_m)
    for first in np.linspace(0, len(poses) - 1, 6).astype(int).tolist()[:-1]:
        apart = are_apart(poses[first], poses[first + 1 :], apart_m, _APART_RAD)
        if apart.any():
            yield first, first + 1 + int(apart.argmax())
