"""The recorded poses that place the most clouds, from file to file of a recording in parts."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from triquad_client.pose import Pose
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.arguments import SENSOR
from triquad_tools.recordings.folders.trajectory import Trajectory
from triquad_tools.recordings.recording import ReadingOptions
from triquad_tools.recordings.ros_content import RosContent, SeenCloud
from triquad_tools.sensors.motion.frame_graph import ROOT_NAMES
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.track import STATIC, Transform
from triquad_tools.sensors.ros.type_store import ALL_TF, TRANSFORMS
from triquad_tools.sensors.sweep import NoScanError, NoTransformError, PosedScan, Sweep

_SLACK_M, _SLACK_S = 1.0, 2.0  # between the parts of a recording the robot goes on as it was
_NO_POSES = (
    "it holds no poses: record /tf with /tf_static, or a topic of odometry or poses, together with "
    "the clouds, or give --trajectory, or find those of a lidar by --odometry; of a sensor that "
    "stands still, --transform, and --points-in sensor"
)


@dataclass(frozen=True)
class PoseSource:
    """Poses that may be used, and the frame to map in."""

    name: str  # a topic, or ALL_TF; empty where there are no poses
    frames: FrameTree
    target: str
    body: str  # the frame whose poses they are, or one that hangs on it
    assumed: bool = False  # nothing says that they are its poses
    remarks: tuple[str, ...] = ()

    def moves(self, frame: str) -> bool:
        """Return whether a frame moves in the one to map in."""
        return self.frames.moves(self.target, frame)

    def know(self, frames: set[str]) -> None:
        """Take frames of which no transform tells anything as that to map in."""
        for frame in frames.difference(self.frames.frames):
            here = Pose((0, 0, 0), (0, 0, 0, 1))
            self.frames.add(Transform(self.target, frame, STATIC, here))

    def seen(self, scan: PosedScan, sweep: Sweep) -> PosedScan:
        """Return a scan whose points stand still in the map as the body saw them."""
        return scan.seen_from(self.pose_of(self.body, sweep.stamp_ns))

    def pose_of(self, frame: str, stamp_ns: int) -> Doubles:
        """Return the pose [4, 4] of a frame in the one to map in, or raise a NoTransformError."""
        stamps = np.array([stamp_ns], np.int64)
        return np.asarray(self.frames.poses(self.target, frame, stamps)[0])

    def find(self, cloud: SeenCloud) -> NoScanError | None:
        """Return why the pose of a cloud is not known; None if it is."""
        if not self.name:
            return NoScanError("no_poses", _NO_POSES)
        times = np.array([cloud.first_ns, cloud.last_ns], np.int64)
        try:
            self.frames.poses(self.target, cloud.frame, times)
        except NoTransformError as error:
            return error
        return None


def choose_poses(
    content: RosContent, clouds: Sequence[SeenCloud], options: ReadingOptions
) -> PoseSource:
    """Return the source that places the most clouds; one without a name if there is none.

    Raises:
        ToolError: the source that was asked for does not exist.
    """
    for transform in options.transforms:
        content.frames.add(transform)
    no_poses = PoseSource("", content.frames, "", "")
    if not clouds:
        return no_poses
    _check_body(content, {cloud.frame for cloud in clouds}, options)
    content.frames.wanted = options.map_frame or ""
    frame = clouds[0].frame
    names = [ALL_TF, *content.poses]
    if options.poses is not None and content.kinds.get(options.poses) not in TRANSFORMS:
        if options.poses not in names:
            known = ", ".join(names)
            raise ToolError(f"--poses {options.poses}: there are no such poses, only {known}")
        names = [options.poses]
    sources = [_source(content, name, frame, options) for name in names]
    for source in sources:
        source.frames.check()
    # Transforms that always hold are no poses.
    moving = [source for source in sources if source.frames.moves(source.target, source.body)]

    def merit(source: PoseSource) -> tuple[int, bool]:
        placed = sum(source.find(cloud) is None for cloud in clouds)
        return placed, source.target in ROOT_NAMES

    # By itself nothing that only static transforms place is a scan; but a sensor may stand still.
    still = sources if options.points_in == SENSOR else [no_poses]
    return max(moving or still, key=merit)


def poses_of_trajectory(
    content: RosContent, clouds: Sequence[SeenCloud], found: Trajectory, options: ReadingOptions
) -> PoseSource:
    """Return the poses of a trajectory: of the body frame that is given, or else of the clouds.

    Raises:
        ToolError: it has no times.
    """
    if found.frames is None:
        raise ToolError(
            f"{found.path}: has no times, which the clouds of a bag need to find their poses"
        )
    for transform in options.transforms:
        content.frames.add(transform)
    sensors = {cloud.frame for cloud in clouds}
    _check_body(content, sensors, options)
    body, target = options.body_frame or min(sensors), options.map_frame or ROOT_NAMES[0]
    known = found.frames.edge(SENSOR)
    assert known is not None
    frames = content.frames.with_track(target, body, known.track)
    return PoseSource(str(found.path), frames, target, body, remarks=found.remarks)


def _check_body(content: RosContent, sensors: set[str], options: ReadingOptions) -> None:
    bodies = {poses.child for poses in content.poses.values()}
    known = {*sensors, *bodies, *content.frames.frames} - {""}
    if options.body_frame is not None and options.body_frame not in known:
        raise ToolError(
            f"--body-frame {options.body_frame}: nothing names it; known are "
            f"{', '.join(sorted(known)) or 'none'}"
        )


def _source(content: RosContent, name: str, frame: str, options: ReadingOptions) -> PoseSource:
    """Return all transforms, or the poses of a topic in all but those that say the same.

    If they do not reach the sensor, finding a cloud says so.
    """
    frames, body = content.frames, options.body_frame
    if name == ALL_TF:
        if frames.moves(frames.root(frame), frame):
            body = frame
        lowest = max(frames.moving, key=lambda edge: len(frames.path(edge.child)), default=None)
        body = body or (frame if lowest is None else lowest.child)
        return PoseSource(ALL_TF, frames, options.map_frame or frames.fixed_frame(body), body)
    poses = content.poses[name]
    assumed = not (body or poses.child)
    # Where a topic does not name the body, it is what the sensor is fixed to.
    body = body or poses.child or frames.root(frame)
    frames = frames.with_track(poses.parent, body, poses.track)
    target = options.map_frame or frames.fixed_frame(body)
    return PoseSource(name, frames, target, body, assumed=assumed)


def check_times(clouds: Sequence[SeenCloud]) -> None:
    """Check that the files of clouds follow each other."""
    for before, after in _seams(clouds):
        over_s = (before[-1].stamp_ns - after[0].stamp_ns) / 1e9
        if over_s > 0:
            raise ToolError(
                f"{before[0].file.name} and {after[0].file.name} overlap by {over_s:.1f} s on "
                f"{after[0].topic}: they are no parts of one recording; map them one by one: "
                f"{before[0].file}, {after[0].file}"
            )


def check_places(clouds: Sequence[SeenCloud], poses: PoseSource) -> None:
    """Check that the robot goes on from file to file of placed clouds where it was."""
    for before, after in _seams(clouds):
        near = *before[-2:], *after[:2]
        at = len(before[-2:]) - 1  # the step from the one part to the other
        places = [poses.pose_of(cloud.frame, cloud.stamp_ns)[:3, 3] for cloud in near]
        steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
        times_s = np.diff([cloud.stamp_ns / 1e9 for cloud in near])
        speeds_m_s = np.delete(steps_m / np.maximum(times_s, 1e-3), at)
        goes_on_s = times_s[at] if times_s[at] <= _SLACK_S else 0.0
        most_m = _SLACK_M + 2 * speeds_m_s.max(initial=0.0) * goes_on_s
        if steps_m[at] > most_m:
            raise ToolError(
                f"{before[0].file.name} and {after[0].file.name}: {times_s[at]:.1f} s lie between "
                f"them, and the robot is {steps_m[at]:.1f} m elsewhere: they are no parts of one "
                "recording; map them one by one, or, where their poses are in one map all the "
                f"same, use --map-frame {poses.target}"
            )


def _seams(clouds: Sequence[SeenCloud]) -> Iterator[tuple[list[SeenCloud], list[SeenCloud]]]:
    """Yield the clouds of each topic in a file and in the one that follows."""
    files: dict[tuple[str, Path], list[SeenCloud]] = defaultdict(list)
    for cloud in clouds:
        files[cloud.topic, cloud.file].append(cloud)
    parts = sorted(files.values(), key=lambda part: (part[0].topic, part[0].stamp_ns))
    return ((a, b) for a, b in pairwise(parts) if a[0].topic == b[0].topic)
