"""Folders with a file for each scan, and the poses that belong to the files."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.folders.file_names import in_order, stamps_of_names
from triquad_tools.recordings.folders.point_file import read_header
from triquad_tools.recordings.folders.trajectory import (
    DEFAULT_PERIOD_NS,
    Trajectory,
    number_of,
    read_pose_files,
    read_trajectory,
    read_viewpoints,
)
from triquad_tools.recordings.recording import DEFAULT_SOURCE, ReadingOptions, ScanEntry, Stream
from triquad_tools.sensors.sweep import NoTransformError, PosedScan

_Read = TypeVar("_Read")

TRAJECTORY_NAMES = (
    "trajectory.txt", "trajectory.log", "poses.txt", "groundtruth.txt", "traj.txt", "*.tum", "*.csv"
)  # fmt: skip
_POSE_FOLDERS = ("pose", "poses")  # with a file for each scan
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


@dataclass(frozen=True)
class ScanFolder:
    """The files of a folder that have poses, in the order of their stamps.

    What a file holds is read when it is asked for.
    """

    files: Sequence[PlacedFile]
    read_file: Callable[[PlacedFile], PosedScan]  # raises a ToolError if it cannot be read
    streams: Sequence[Stream]
    remarks: Sequence[str] = ()  # on files without a pose, and on what else was not used

    def __len__(self) -> int:
        return len(self.files)

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The entries of all files."""
        return [ScanEntry(file.stamp_ns, DEFAULT_SOURCE) for file in self.files]

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers.

        Raises:
            ToolError: a file cannot be read; it is named.
        """
        return (self.read_file(self.files[index]) for index in indices)


def checked(paths: Sequence[Path], read: Callable[[Path], _Read]) -> Iterator[_Read]:
    """Yield what is read of each file, with progress: a damaged one is named before any is used."""
    with progress("looking through the recording", len(paths)) as report:
        for number, path in enumerate(paths, start=1):
            yield read(path)
            report(number, f"{number} of {len(paths)} files")


class PlacedFiles(NamedTuple):
    """The files that can be mapped, in the order of their stamps."""

    files: list[PlacedFile]
    trajectory: Trajectory  # from which their poses are
    remarks: list[str]  # on those that cannot, and on what else was not used


def place_files(
    folder: Path,
    options: ReadingOptions,
    paths: Sequence[Path],
    stamps_ns: Sequence[int] | None = None,
    found: Trajectory | None = None,
) -> PlacedFiles:
    """Give the files of a folder their poses: by their times or numbers, or else in order.

    Args:
        folder: holds the trajectory, unless that is given.
        options: name the file of the trajectory, and the order of its quaternions.
        paths: the files, one at least, in order.
        stamps_ns: when each was taken; ``None``: as their names say, if they do.
        found: the poses, where they are known already.

    Raises:
        ToolError: there is no trajectory, or no way is possible.
    """
    trajectory, remarks = (found, []) if found else _choose(folder, paths, options)
    remarks += trajectory.remarks
    if stamps_ns is None and (stamps_ns := stamps_of_names(paths)) is not None:
        stamps_ns, paths = zip(*sorted(zip(stamps_ns, paths, strict=True)), strict=True)
    placed = _placed(paths, stamps_ns, trajectory, remarks)
    known = [file for file in placed if np.isfinite(file.world_from_sensor).all()]
    if not known:
        raise ToolError(f"{trajectory.path}: says no pose for any of {len(paths)} files")
    if (count := len(placed) - len(known)) > 0:
        told = f"{count} of {len(paths)} files are left out, as {trajectory.path.name} says no pose"
        remarks.append(f"{told} for them")
    return PlacedFiles(known, trajectory, remarks)


def _placed(
    paths: Sequence[Path], stamps: Sequence[int] | None, trajectory: Trajectory, remarks: list[str]
) -> list[PlacedFile]:
    """Return the files that have poses, some of which may not be finite; add to the remarks."""
    path = trajectory.path
    timed = stamps is not None and trajectory.frames is not None
    if stamps is not None and timed and (placed := _by_time(paths, stamps, trajectory, remarks)):
        return placed
    known = trajectory.numbers or ()
    pose_of: dict[int | None, Doubles] = dict(zip(known, trajectory.poses, strict=False))
    numbers = [number_of(path) for path in paths]
    shared = {*numbers} & {*pose_of}
    # As many files as poses, of which not all have common numbers, may be counted in two ways.
    if shared and (len(shared) == len(paths) or len(pose_of) != len(paths)):
        when = stamps or [(number or 0) * DEFAULT_PERIOD_NS for number in numbers]
        found = [pose_of.get(number, np.full((4, 4), np.nan)) for number in numbers]
        return list(map(PlacedFile, paths, when, found))
    if len(paths) == len(trajectory.poses) and not pose_of:
        when = stamps if stamps is not None and not timed else trajectory.stamps_ns.tolist()
        if timed:
            remarks.append(
                f"the times of the files, such as {paths[0].name}, are of another clock than those "
                f"of {path.name}: files and poses, of which there are as many, go in order"
            )
        return list(map(PlacedFile, paths, when, trajectory.poses))
    if stamps is not None and timed:
        first, last = (stamp / 1e9 for stamp in (min(stamps), max(stamps)))
        start, end = (stamp / 1e9 for stamp in trajectory.stamps_ns[[0, -1]].tolist())
        raise ToolError(
            f"{paths[0].parent}: no file has a pose: they were taken from {first:.3f} to "
            f"{last:.3f} s, and {path} goes from {start:.3f} to {end:.3f} s, with gaps of at most "
            "2 s; write both with the times of one clock"
        )
    what = "the trajectory has no times" if stamps is not None else "their names hold no times"
    what = "their numbers are not those of the poses" if pose_of else what
    raise ToolError(
        f"{paths[0].parent}: {len(paths)} files such as {paths[0].name}, and "
        f"{len(trajectory.poses)} poses in {path}, and {what}: give every file one pose, or times "
        "to both"
    )


def _choose(
    folder: Path, paths: Sequence[Path], options: ReadingOptions
) -> tuple[Trajectory, list[str]]:
    given, order = options.trajectory, options.quaternion
    if given is not None:
        path = next((each for each in (given, folder / given) if each.exists()), None)
        if path is None:
            raise ToolError(f"{given}: no such file")
        if path.is_file():
            return read_trajectory(path, order), []
        if files := in_order(path.glob("*.txt")):
            return read_pose_files(files), []
    places = dict.fromkeys((folder, paths[0].parent))
    found = [
        path for each in places for name in TRAJECTORY_NAMES for path in sorted(each.glob(name))
    ]
    # The official layout of KITTI: sequences/00 and poses/00.txt.
    sequence = folder.resolve()
    of_kitti = sequence.parent.parent / "poses" / f"{sequence.name}.txt"
    found += [of_kitti] if of_kitti.is_file() else []
    if found:
        others = ", ".join(path.name for path in found[1:])
        remark = f"poses are those of {found[0].name}, not of {others}: --trajectory FILE chooses"
        return read_trajectory(found[0], order), [remark] if others else []
    of_files = [paths[0].parent.glob("*.pose.txt")]
    of_files += [(folder / name).glob("*.txt") for name in _POSE_FOLDERS]
    if files := next(filter(None, map(in_order, of_files)), []):
        return read_pose_files(files), []
    if (viewpoints := _viewpoints(paths)) is not None:
        return viewpoints, ["poses are the VIEWPOINT of each PCD, as there is no trajectory"]
    raise ToolError(
        f"{folder}: holds no trajectory, {', '.join(TRAJECTORY_NAMES)}: put one there, or name it "
        "with --trajectory; those of a lidar are found by --odometry"
    )


def _viewpoints(paths: Sequence[Path]) -> Trajectory | None:
    """Return the poses in the headers of PCD files, if they differ from each other."""
    if paths[0].suffix.lower() != ".pcd":
        return None
    try:
        headers = [line for path in paths for line in read_header(path)]
    except ValueError:  # told when the points are read
        return None
    said = [" ".join(line[1:]) for line in headers if line[0] == "VIEWPOINT"]
    is_posed = len(said) == len(paths) and len({*said}) > 1
    return read_viewpoints(paths, said) if is_posed else None


def _by_time(
    paths: Sequence[Path], stamps_ns: Sequence[int], trajectory: Trajectory, remarks: list[str]
) -> list[PlacedFile]:
    placed: list[PlacedFile] = []
    left_out: Counter[str] = Counter()
    for stamp, path in sorted(zip(stamps_ns, paths, strict=True)):
        try:
            placed.append(PlacedFile(path, stamp, trajectory.pose_at(stamp)))
        except NoTransformError as error:
            left_out[error.reason] += 1
    for reason, count in left_out.items() if placed else ():
        told = f"{count} of {len(paths)} files are left out: they were taken {_WHY[reason]} of"
        remarks.append(f"{told} {trajectory.path.name}")
    return placed
