"""Poses as robots report them: ``TFMessage``, ``Odometry`` and ``PoseStamped``."""

from typing import Any

from triquad_client.pose import Pose

from triquad_tools.sensors.motion.frame_tree import STATIC, Transform
from triquad_tools.sensors.ros.header import frame_name, stamp_ns


def transforms_of_tf(message: Any, *, static: bool) -> list[Transform]:
    """Return the transforms of a ``TFMessage``, which always hold where they are ``static``."""
    return [
        Transform(
            parent=frame_name(each.header.frame_id),
            child=frame_name(each.child_frame_id),
            stamp_ns=STATIC if static else stamp_ns(each.header),
            pose=_pose(each.transform.translation, each.transform.rotation),
        )
        for each in message.transforms
    ]


def transform_of_odometry(message: Any) -> Transform:
    """Return where the robot's body was, as an ``Odometry`` has it."""
    return Transform(
        parent=frame_name(message.header.frame_id),
        child=frame_name(message.child_frame_id),
        stamp_ns=stamp_ns(message.header),
        pose=_pose(message.pose.pose.position, message.pose.pose.orientation),
    )


def transform_of_pose(message: Any) -> Transform:
    """Return where something was by a ``PoseStamped``, which does not name it."""
    return Transform(
        parent=frame_name(message.header.frame_id),
        child="",
        stamp_ns=stamp_ns(message.header),
        pose=_pose(message.pose.position, message.pose.orientation),
    )


def _pose(position: Any, rotation: Any) -> Pose:
    return Pose(
        (position.x, position.y, position.z), (rotation.x, rotation.y, rotation.z, rotation.w)
    )
