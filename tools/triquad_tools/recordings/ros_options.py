"""Options for reading a recording of ROS, where its content leaves a choice."""

from dataclasses import dataclass

from triquad_client.pose import Pose

from triquad_tools.console.command import ToolError
from triquad_tools.sensors.motion.frame_tree import STATIC, Transform
from triquad_tools.sensors.ros.header import frame_name


@dataclass(frozen=True)
class RosOptions:
    """A user's choices for a recording; those left out are determined."""

    topics: tuple[str, ...] = ()  # of clouds or depth images
    poses: str | None = None  # topic of odometry or poses, or "tf"
    map_frame: str | None = None
    body_frame: str | None = None  # whose poses those of the topic are
    depth_stride: int = 1  # take every N-th row and column of depth images
    recorder_clock: bool = False  # stamps are when a message was recorded
    transforms: tuple[Transform, ...] = ()  # that the recording lacks


def parse_transform(text: str) -> Transform:
    """Return a transform such as ``base_link lidar 0 0 1.5 0 0 0 1``: position and quaternion.

    Raises:
        ToolError: it is none.
    """
    words = text.split()
    try:
        parent, child, *numbers = words
        x, y, z, *quaternion = map(float, numbers)
        pose = Pose((x, y, z), quaternion)
        pose.matrix()
    except ValueError as error:
        raise ToolError(
            f"--transform {text!r}: use 'PARENT CHILD X Y Z QX QY QZ QW', such as "
            f"'base_link lidar 0 0 1.5 0 0 0 1' ({error})"
        ) from error
    return Transform(frame_name(parent), frame_name(child), STATIC, pose)
