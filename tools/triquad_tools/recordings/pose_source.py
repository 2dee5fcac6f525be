"""The choice of the recorded poses that give the poses of the sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.ros_options import RosOptions
from triquad_tools.recordings.ros_survey import SeenCloud, Survey
from triquad_tools.sensors.errors import NoTransformError
from triquad_tools.sensors.motion.frame_tree import ROOT_NAMES, FrameTree

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

    def find(self, cloud: SeenCloud) -> NoTransformError | None:
        """Return why the pose of a cloud is not known; None if it is."""
        times = np.array([cloud.first_ns, cloud.last_ns], np.int64)
        try:
            self.frames.poses(self.target, cloud.frame, times)
        except NoTransformError as error:
            return error
        return None

    @property
    def moves(self) -> bool:
        """Return whether they are poses at all: transforms that always hold are none."""
        return self.frames.moves(self.target, self.body)


def choose_poses(
    found: Survey, clouds: Sequence[SeenCloud], options: RosOptions
) -> PoseSource | None:
    """Return the source that places the most clouds; None if there is no pose at all.

    Raises:
        ToolError: the source that was asked for does not exist.
    """
    for transform in options.transforms:
        found.frames.add(transform)
    frame = clouds[0].frame
    sources = [_of_tf(found, frame, options)]
    sources += [_of_topic(found, topic, frame, options) for topic in found.poses]
    if options.poses is not None:
        sources = [source for source in sources if source.name == options.poses]
        if not sources:
            there = ", ".join([TF, *found.poses])
            raise ToolError(f"--poses {options.poses}: there are no such poses, only {there}")
    sources = [source for source in sources if source.moves]
    return max(sources, key=lambda source: _merit(source, clouds), default=None)


def _merit(source: PoseSource, clouds: Sequence[SeenCloud]) -> tuple[int, bool]:
    placed = sum(source.find(cloud) is None for cloud in clouds)
    return placed, source.target in ROOT_NAMES


def _of_tf(found: Survey, frame: str, options: RosOptions) -> PoseSource:
    """Return all transforms. If they do not reach the sensor, finding a cloud says so."""
    frames, body = found.frames, frame
    if not frames.moves(frames.root(frame), frame):
        body = next(iter(frames.moving), frame)
    return PoseSource(TF, frames, options.map_frame or frames.fixed_frame(body), body)


def _of_topic(found: Survey, topic: str, frame: str, options: RosOptions) -> PoseSource:
    """Return the poses of a topic, in the tree of all transforms but those that say the same."""
    poses = found.poses[topic]
    # Where a topic does not name the body, it is what the sensor is fixed to.
    body = options.body_frame or poses.child or found.frames.root(frame)
    frames = found.frames.with_track(poses.parent, body, poses.track)
    target = options.map_frame or frames.fixed_frame(body)
    assumed = not (options.body_frame or poses.child)
    return PoseSource(topic, frames, target, body, assumed=assumed)
