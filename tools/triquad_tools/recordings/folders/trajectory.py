"""Files that say where a sensor was; ``trajectory_forms.py`` tells how they are written."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_client.pose import UNIT_TOLERANCE
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.pose import pose_matrices

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.arguments import SENSOR, WORLD
from triquad_tools.recordings.folders.trajectory_forms import Form, order_of, read_form
from triquad_tools.recordings.text_lines import Line, parse_time, read_lines, rigid, unit_ns
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.track import Track
from triquad_tools.sensors.sweep import NoTransformError

DEFAULT_PERIOD_NS = 100_000_000  # the time between scans of a recording without times
_ROUNDING_NS = 1_000_000  # files write times with as few as three decimals
_ANGLES = (
    "; nearly all are so: where the lines have roll, pitch and yaw, write quaternions of them, as "
    "Rotation.from_euler('xyz', angles).as_quat() of scipy returns them"
)


@dataclass(frozen=True)
class Trajectory:
    """The poses of a sensor, at some times, of scans with some numbers, or merely in some order."""

    path: Path
    kind: str
    poses: Doubles  # [n, 4, 4] world_from_sensor; not finite where the file says no pose
    stamps_ns: Longs  # [n] in order; ten a second where the file has no times
    frames: FrameTree | None = None  # the sensor's motion; None where the file has no times
    numbers: Sequence[int] | None = None  # [n] of the scans, where the file has them
    remarks: tuple[str, ...] = ()

    def pose_at(self, stamp_ns: int) -> Doubles:
        """Return the pose [4, 4] at a time, of a trajectory that has times.

        It is not finite where the file says no pose for this time.

        Raises:
            NoTransformError: the time lies before the first pose, after the last or in a gap.
        """
        assert self.frames is not None
        nearest = int(np.abs(self.stamps_ns - stamp_ns).argmin())
        pose: Doubles = self.poses[nearest]
        try:
            if np.isfinite(pose).all():
                pose = self.frames.poses(WORLD, SENSOR, np.array([stamp_ns]))[0]
        except NoTransformError:
            if abs(int(self.stamps_ns[nearest]) - stamp_ns) > _ROUNDING_NS:
                raise
        return pose


def read_trajectory(path: Path, order: str | None = None) -> Trajectory:
    """Return the poses of a file; ``order`` says how it writes quaternions, ``xyzw`` or ``wxyz``.

    A pose that is not finite is no pose, and lines are sorted by their times; both is remarked.

    Raises:
        ToolError: it has no poses, or a line is none.
    """
    return _trajectory(path, *read_form(path), order)


def read_pose_files(paths: Sequence[Path]) -> Trajectory:
    """Return the poses of files of one matrix each, for scans with the same numbers in their names.

    Raises:
        ToolError: a file does not hold 12 or 16 numbers, or all say no pose.
    """
    lines = [Line(str(path), " ".join(line.text for line in read_lines(path))) for path in paths]
    form = Form("a pose a file", "m" * len(lines[0].words))
    for path, line in zip(paths, lines, strict=True):
        if len(line.words) not in (12, 16) or len(line.words) != len(form.columns):
            raise ToolError(f"{path}: {len(line.words)} numbers where a pose has 16")
    files = paths[0].parent / f"*{''.join(paths[0].suffixes)}"
    numbers = [number_of(path) or 0 for path in paths]
    return replace(_trajectory(files, form, lines), numbers=numbers)


def read_viewpoints(paths: Sequence[Path], texts: Sequence[str]) -> Trajectory:
    """Return the poses that PCD files have as ``VIEWPOINT``, in the order of the files."""
    form = Form("VIEWPOINT", ["x", "y", "z", "qw", "qx", "qy", "qz"], has_header=True)
    lines = [Line(str(path), text) for path, text in zip(paths, texts, strict=True)]
    return _trajectory(paths[0].parent / "*.pcd", form, lines)


def number_of(path: Path) -> int | None:
    """Return the last whole number in a name, such as 12 of ``frame-000012.pose.txt``."""
    found = re.findall(r"\d+", path.name.partition(".")[0])
    return int(found[-1]) if found else None


def _trajectory(
    path: Path, form: Form, lines: Sequence[Line], order: str | None = None
) -> Trajectory:
    is_timed = bool({"t", "sec"} & {*form.columns})
    keys = form.numbers(lines, *(("t", "sec", "nsec") if is_timed else ("n",)))
    is_known = np.asarray(np.isfinite(keys).all(axis=1))
    known = [line for line, is_one in zip(lines, is_known, strict=True) if is_one]
    poses = _poses(form, known, order)
    is_known[is_known] = np.isfinite(poses[:, 0, 3])
    remarks: tuple[str, ...] = ()
    if not is_known.all():
        first = lines[int(is_known.argmin())].place
        if not is_known.any():
            raise ToolError(f"{first}: no finite pose, nor in any other line")
        told = f"{(~is_known).sum()} of {len(lines)} poses are left out, as they are not finite"
        remarks = (f"{told} or no rotation, the first at {first}",)
    stamps = np.arange(len(poses), dtype=np.int64) * DEFAULT_PERIOD_NS
    found = Trajectory(path, form.name, poses, stamps, remarks=remarks)
    if is_timed:
        known_at = timed(path, form.name, poses, _stamps(form, known))
        return replace(known_at, remarks=(*remarks, *known_at.remarks))
    numbers = form.numbers(known, "n").astype(np.int64).ravel().tolist()
    return replace(found, numbers=numbers or None)


def timed(path: Path, kind: str, poses: Doubles, stamps: Longs) -> Trajectory:
    """Return the trajectory of poses [n, 4, 4] at times [n]; those that are not finite are none.

    Raises:
        ToolError: the poses jump to and fro.
    """
    remarks, track = list[str](), Track()
    order = np.argsort(stamps, kind="stable")
    poses, ordered = poses[order], stamps[order]
    backwards, repeated = int((np.diff(stamps) < 0).sum()), int((np.diff(ordered) == 0).sum())
    of_all = f"{path}: has {len(stamps)} poses, some with a time"
    if backwards:
        remarks.append(f"{of_all} before that of the line above ({backwards}): sorted by time")
    if repeated:
        remarks.append(f"{of_all} that of another pose ({repeated}): the last of each is taken")
    known = np.isfinite(poses[:, 0, 3])
    turns = Rotation.from_matrix(poses[known, :3, :3]).as_quat()
    rows = zip(ordered[known].tolist(), poses[known, :3, 3].tolist(), turns.tolist(), strict=True)
    for stamp, position, turn in rows:
        track.add(stamp, position, turn)
    count, jump_m = track.jumps()
    if count:
        raise ToolError(
            f"{path}: its poses jump to and fro, {count} times, by {jump_m:.2g} m: it has "
            "those of two trajectories: leave one of them"
        )
    frames = FrameTree().with_track(WORLD, SENSOR, track)
    return Trajectory(path, kind, poses, ordered, frames, None, tuple(remarks))


def _stamps(form: Form, lines: Sequence[Line]) -> Longs:
    parts = [form.columns.index(name) for name in ("t", "sec", "nsec") if name in form.columns]
    units = [10**9, 1][: len(parts)]
    if len(parts) == 1 and lines:
        units = [form.unit_ns or unit_ns(lines[0], lines[0].words[parts[0]])]
    both = list(zip(parts, units, strict=True))
    stamps = [sum(parse_time(line, line.words[i], unit) for i, unit in both) for line in lines]
    return np.array(stamps, np.int64)


def _poses(form: Form, lines: Sequence[Line], order: str | None) -> Doubles:
    """Return poses [n, 4, 4] of lines, not finite where a line says none."""
    if "m" in form.columns:
        rows = zip(lines, form.numbers(lines, "m"), strict=True)
        nowhere = np.full((4, 4), np.nan)
        found = [rigid(line.place, m) if np.isfinite(m).all() else nowhere for line, m in rows]
        return np.array(found).reshape(-1, 4, 4)
    positions = form.numbers(lines, "x", "y", "z")
    names = [name for name in form.columns if name[0] == "q"]  # in the order of the file
    quaternions = form.numbers(lines, *names)
    finite = np.isfinite(positions).all(axis=1) & np.isfinite(quaternions).all(axis=1)
    finite &= np.abs(quaternions).max(axis=1, initial=0.0) > 0
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = finite & (np.abs(lengths - 1) > UNIT_TOLERANCE)
    if wrong.any():
        index = int(wrong.argmax())
        raise ToolError(
            f"{lines[index].place}: the quaternion {quaternions[index].tolist()} has the length "
            f"{lengths[index]:.4g}, not 1; a line is {' '.join(form.columns)}"
            f"{_ANGLES if wrong.sum() > finite.sum() / 2 else ''}"
        )
    order = order or order_of(form, quaternions[finite], lines)
    names = [f"q{axis}" for axis in order] if order != form.order else names
    quaternions = quaternions[:, [names.index(f"q{axis}") for axis in "xyzw"]]
    poses = np.full((len(lines), 4, 4), np.nan)
    units = quaternions[finite] / lengths[finite, None]
    poses[finite] = pose_matrices(positions[finite], units)
    return poses
