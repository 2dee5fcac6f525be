"""Files of one scan each, and the poses that belong to them."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.folders.file_names import stamps_of_names
from triquad_tools.recordings.folders.trajectory import (
    TRAJECTORY_NAMES,
    Trajectory,
    find_trajectories,
)
from triquad_tools.recordings.recording import DEFAULT_SOURCE, ScanEntry
from triquad_tools.sensors.errors import NoTransformError

_Found = TypeVar("_Found")

_WHY = {
    "pose_early": "before the first pose",
    "pose_late": "after the last pose",
    "pose_gap": "between poses that lie too far apart",
}


class PlacedFile(NamedTuple):
    """A file, and where and when its scan was taken."""

    path: Path
    stamp_ns: int
    world_from_sensor: Doubles  # [4, 4]


class PlacedFiles(NamedTuple):
    """The files that can be mapped, in the order of their stamps."""

    files: tuple[PlacedFile, ...]
    remarks: tuple[str, ...]  # on those that cannot, and on what else was not used

    def with_remarks(self, remarks: tuple[str, ...]) -> "PlacedFiles":
        """Return the same files, with other remarks before their own."""
        return self._replace(remarks=(*remarks, *self.remarks))

    @property
    def entries(self) -> list[ScanEntry]:
        """The entries of a recording that consists of these files."""
        return [ScanEntry(file.stamp_ns, DEFAULT_SOURCE) for file in self.files]


class ChosenTrajectory(NamedTuple):
    """The file of a folder from which poses are taken."""

    path: Path
    remarks: tuple[str, ...]  # on those that are not


def look_through(paths: Sequence[Path], check: Callable[[Path], _Found]) -> list[_Found]:
    """Return what a check finds of each file, with progress: there may be many."""
    found: list[_Found] = []
    with progress("looking through the recording", len(paths)) as report:
        for path in paths:
            found.append(check(path))
            report(len(found), f"{len(found)} of {len(paths)} files")
    return found


def choose_trajectory(folder: Path, given: Path | None) -> ChosenTrajectory:
    """Return the trajectory that was given, or that a folder holds.

    Raises:
        ToolError: there is none.
    """
    if given is not None:
        if not given.is_file():
            raise ToolError(f"{given}: no such file")
        return ChosenTrajectory(given, ())
    found = find_trajectories(folder)
    if not found:
        raise ToolError(
            f"{folder}: holds no trajectory, {', '.join(TRAJECTORY_NAMES)}: put one there, or name "
            "it with --trajectory"
        )
    others = ", ".join(path.name for path in found[1:])
    remark = f"poses are those of {found[0].name}, not of {others}: --trajectory FILE chooses"
    return ChosenTrajectory(found[0], (remark,) if others else ())


def place_files(paths: Sequence[Path], trajectory: Trajectory) -> PlacedFiles:
    """Give files their poses: by the times in their names, or else one to one in order.

    Raises:
        ToolError: neither is possible.
    """
    stamps = stamps_of_names(paths)
    timed = trajectory.frames is not None
    if stamps is not None and timed:
        placed = _by_time(paths, stamps, trajectory)
        if placed.files:
            return placed
    if len(paths) == len(trajectory):
        return _by_order(paths, trajectory, remark=stamps is not None and timed)
    if stamps is not None and timed:
        raise _no_common_time(stamps, trajectory, paths[0].parent)
    what = "the trajectory has no times" if stamps is not None else "their names hold no times"
    raise ToolError(
        f"{paths[0].parent}: {len(paths)} files such as {paths[0].name}, and {len(trajectory)} "
        f"poses in {trajectory.path}, and {what}: give every file one pose, or times to both"
    )


def place_by_time(
    paths: Sequence[Path], stamps_ns: Sequence[int], trajectory: Trajectory
) -> PlacedFiles:
    """Give files, which were taken at given times, their poses.

    Raises:
        ToolError: the trajectory has no times, or no pose for any of the files.
    """
    if trajectory.frames is None:
        raise ToolError(f"{trajectory.path}: has no times; write lines of t x y z qx qy qz qw")
    placed = _by_time(paths, stamps_ns, trajectory)
    if not placed.files:
        raise _no_common_time(stamps_ns, trajectory, paths[0].parent)
    return placed


def _by_time(
    paths: Sequence[Path], stamps_ns: Sequence[int], trajectory: Trajectory
) -> PlacedFiles:
    placed: list[PlacedFile] = []
    left_out: Counter[str] = Counter()
    for stamp, path in sorted(zip(stamps_ns, paths, strict=True)):
        try:
            placed.append(PlacedFile(path, stamp, trajectory.pose_at(stamp)))
        except NoTransformError as error:
            left_out[error.reason] += 1
    remarks = [
        f"{count} of {len(paths)} files are left out: they were taken {_WHY[reason]} of "
        f"{trajectory.path.name}"
        for reason, count in left_out.items()
    ]
    return PlacedFiles(tuple(placed), tuple(remarks))


def _by_order(paths: Sequence[Path], trajectory: Trajectory, *, remark: bool) -> PlacedFiles:
    poses = zip(paths, trajectory.stamps_ns.tolist(), trajectory.poses, strict=True)
    text = (
        f"the times in the names, such as {paths[0].name}, are of another clock than those of "
        f"{trajectory.path.name}: files and poses, of which there are as many, go in order"
    )
    return PlacedFiles(tuple(PlacedFile(*each) for each in poses), (text,) if remark else ())


def _no_common_time(stamps_ns: Sequence[int], trajectory: Trajectory, folder: Path) -> ToolError:
    first, last = (stamp / 1e9 for stamp in (min(stamps_ns), max(stamps_ns)))
    start, end = (stamp / 1e9 for stamp in trajectory.stamps_ns[[0, -1]].tolist())
    return ToolError(
        f"{folder}: no file has a pose: they were taken from {first:.3f} to {last:.3f} s, and "
        f"{trajectory.path} goes from {start:.3f} to {end:.3f} s, with gaps of at most 2 s; write "
        "both with the times of one clock"
    )
