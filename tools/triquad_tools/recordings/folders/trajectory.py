"""Files that say where a sensor was.

Which format a file has follows from its first line: 8 numbers of TUM (``t x y z qx qy qz qw``,
seconds), 12 of KITTI (a row-major 3 x 4 pose a line, without times), or the 3 with which each
pose begins in a ``.log`` of Open3D (then a 4 x 4 pose in four lines, without times).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client.errors import InvalidScanError
from triquad_client.pose import Pose
from triquad_format.records.arrays import Doubles, Longs

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.recording import SENSOR, WORLD
from triquad_tools.recordings.text_lines import (
    Line,
    parse_numbers,
    parse_rigid,
    parse_stamps,
    read_lines,
)
from triquad_tools.sensors.motion.frame_tree import FrameTree, Transform
from triquad_tools.sensors.sweep import NoTransformError

DEFAULT_PERIOD_NS = 100_000_000
"""The time between scans of a recording without times."""

_ROUNDING_NS = 1_000_000  # files write times with as few as three decimals


@dataclass(frozen=True)
class Trajectory:
    """The poses of a sensor, at some times or merely in some order."""

    path: Path
    kind: str
    poses: Doubles  # [n, 4, 4] world_from_sensor
    stamps_ns: Longs  # [n]; ten a second where the file has no times
    frames: FrameTree | None  # the sensor's motion; None where the file has no times

    def pose_at(self, stamp_ns: int) -> Doubles:
        """Return the pose [4, 4] at a time, of a trajectory that has times.

        Raises:
            NoTransformError: the time lies before the first pose, after the last or in a gap.
        """
        assert self.frames is not None
        try:
            pose: Doubles = self.frames.poses(WORLD, SENSOR, np.array([stamp_ns]))[0]
        except NoTransformError:
            nearest = int(np.abs(self.stamps_ns - stamp_ns).argmin())
            if abs(int(self.stamps_ns[nearest]) - stamp_ns) > _ROUNDING_NS:
                raise
            pose = self.poses[nearest]
        return pose


def read_trajectory(path: Path) -> Trajectory:
    """Return the poses of a file.

    Raises:
        ToolError: it has none, a line is no pose, or times run backwards.
    """
    lines = read_lines(path)
    if not lines:
        raise ToolError(f"{path}: holds no poses")
    match len(lines[0].words):
        case 8:
            return _read_tum(path, lines)
        case 12:
            poses = [parse_rigid(line.place, line.words) for line in lines]
            return _untimed(path, "KITTI poses", poses)
        case 3:
            return _untimed(path, "Open3D log", _poses_of_log(path, lines))
        case count:
            raise ToolError(
                f"{lines[0].place}: {count} numbers, where a pose has 8 (t x y z qx qy qz qw), 12 "
                "(3 x 4), or begins with 3 (Open3D's .log); comments begin with #"
            )


def _read_tum(path: Path, lines: Sequence[Line]) -> Trajectory:
    frames, stamps = FrameTree(), parse_stamps(lines)
    poses: list[Doubles] = []
    for line, stamp_ns in zip(lines, stamps, strict=True):
        if len(line.words) != 8:
            raise ToolError(f"{line.place}: {len(line.words)} numbers where a pose has 8")
        numbers = parse_numbers(line.place, line.words[1:])
        pose = Pose(numbers[:3], numbers[3:])
        try:
            poses.append(pose.matrix())
        except InvalidScanError as error:
            raise ToolError(
                f"{line.place}: {error}; a line is t x y z qx qy qz qw, w last"
            ) from error
        frames.add(Transform(WORLD, SENSOR, stamp_ns, pose))
    return Trajectory(path, "TUM trajectory", np.array(poses), np.array(stamps), frames)


def _poses_of_log(path: Path, lines: Sequence[Line]) -> list[Doubles]:
    """Return poses of five lines each: three whole numbers, and the rows of a matrix."""
    if len(lines) % 5:
        raise ToolError(
            f"{path}: {len(lines)} lines are not whole poses of Open3D's .log, which take 5 each; "
            "copy it again"
        )
    poses = []
    for start in range(0, len(lines), 5):
        first, *rows = lines[start : start + 5]
        lengths = [len(row.words) for row in rows]
        if len(first.words) != 3 or lengths != [4, 4, 4, 4]:
            raise ToolError(f"{first.place}: not 3 numbers and four rows of 4, as in Open3D's .log")
        if parse_numbers(rows[3].place, rows[3].words) != [0, 0, 0, 1]:
            raise ToolError(f"{rows[3].place}: {rows[3].text!r} where a pose ends with 0 0 0 1")
        poses.append(parse_rigid(first.place, [word for row in rows[:3] for word in row.words]))
    return poses


def _untimed(path: Path, kind: str, poses: Sequence[Doubles]) -> Trajectory:
    stamps = np.arange(len(poses), dtype=np.int64) * DEFAULT_PERIOD_NS
    return Trajectory(path, kind, np.array(poses), stamps, frames=None)
