"""The recorded poses that place the most clouds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from triquad_client.pose import Pose

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.recording import ReadingOptions
from triquad_tools.recordings.ros_content import RosContent, SeenCloud
from triquad_tools.sensors.motion.frame_tree import ROOT_NAMES, STATIC, FrameTree, Transform
from triquad_tools.sensors.ros.type_store import TRANSFORMS
from triquad_tools.sensors.sweep import NoTransformError, PosedScan, Sweep, moved

TF = "tf"
"""Stands for all transforms, whatever their topics."""


@dataclass(frozen=True)
class PoseSource:
    """Poses that may be used, and the frame to map in."""

    name: str  # a topic, or TF
    frames: FrameTree
    target: str
    body: str  # the frame whose poses they are, or one that hangs on it
    assumed: bool = False  # nothing says that they are its poses

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
        stamps = np.array([sweep.stamp_ns], np.int64)
        (pose,) = self.frames.poses(self.target, self.body, stamps)
        points = moved(scan.points, np.linalg.inv(pose) @ scan.world_from_sensor)
        return PosedScan(points.astype(np.float32), pose)

    def find(self, cloud: SeenCloud) -> NoTransformError | None:
        """Return why the pose of a cloud is not known; None if it is."""
        times = np.array([cloud.first_ns, cloud.last_ns], np.int64)
        try:
            self.frames.poses(self.target, cloud.frame, times)
        except NoTransformError as error:
            return error
        return None


def choose_poses(
    content: RosContent, clouds: Sequence[SeenCloud], options: ReadingOptions
) -> PoseSource | None:
    """Return the source that places the most clouds; None if there is no pose at all.

    Raises:
        ToolError: the source that was asked for does not exist.
    """
    for transform in options.transforms:
        content.frames.add(transform)
    _check_body(content, {cloud.frame for cloud in clouds}, options)
    content.frames.wanted = options.map_frame or ""
    frame = clouds[0].frame
    names = [TF, *content.poses]
    if options.poses is not None and content.kinds.get(options.poses) not in TRANSFORMS:
        if options.poses not in names:
            raise ToolError(
                f"--poses {options.poses}: there are no such poses, only {', '.join(names)}"
            )
        names = [options.poses]
    sources = [
        _of_tf(content.frames, frame, options)
        if name == TF
        else _of_topic(content, name, frame, options)
        for name in names
    ]
    for source in sources:
        source.frames.check()
    # Transforms that always hold are no poses.
    moving = [source for source in sources if source.frames.moves(source.target, source.body)]

    def merit(source: PoseSource) -> tuple[int, bool]:
        placed = sum(source.find(cloud) is None for cloud in clouds)
        return placed, source.target in ROOT_NAMES

    return max(moving, key=merit, default=None)


def _of_tf(frames: FrameTree, frame: str, options: ReadingOptions) -> PoseSource:
    """Return all transforms. If they do not reach the sensor, finding a cloud says so."""
    body = frame
    if not frames.moves(frames.root(frame), frame):
        body = options.body_frame or frames.lowest_moving or frame
    return PoseSource(TF, frames, options.map_frame or frames.fixed_frame(body), body)


def _check_body(content: RosContent, sensors: set[str], options: ReadingOptions) -> None:
    """Refuse a frame for the body that nothing names.

    Raises:
        ToolError: there is none of this name.
    """
    bodies = {poses.child for poses in content.poses.values()}
    known = {*sensors, *bodies, *content.frames.frames} - {""}
    if options.body_frame is not None and options.body_frame not in known:
        raise ToolError(
            f"--body-frame {options.body_frame}: nothing names it; known are "
            f"{', '.join(sorted(known)) or 'none'}"
        )


def _of_topic(content: RosContent, topic: str, frame: str, options: ReadingOptions) -> PoseSource:
    """Return the poses of a topic, in the tree of all transforms but those that say the same."""
    poses = content.poses[topic]
    # Where a topic does not name the body, it is what the sensor is fixed to.
    body = options.body_frame or poses.child or content.frames.root(frame)
    frames = content.frames.with_track(poses.parent, body, poses.track)
    target = options.map_frame or frames.fixed_frame(body)
    assumed = not (options.body_frame or poses.child)
    return PoseSource(topic, frames, target, body, assumed=assumed)
