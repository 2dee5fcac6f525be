"""Poses as robots report them: ``TFMessage``, ``Odometry`` and ``PoseStamped``."""

from typing import Any

from triquad_client.pose import Pose

from triquad_tools.sensors.motion.frame_tree import Transform
from triquad_tools.sensors.ros.header import frame_name, stamp_ns
from triquad_tools.sensors.ros.type_store import ODOMETRY, POSE


def transforms_of(kind: str, message: Any, body_frame: str) -> list[Transform]:
    """Return the transforms of a message of a kind, at the times of its headers.

    ``body_frame`` is whose pose it is where it does not say so, as a ``PoseStamped``.
    """
    if kind == POSE:
        where = message.pose
        return [_transform(message.header, body_frame, where.position, where.orientation)]
    if kind == ODOMETRY:
        where, child = message.pose.pose, message.child_frame_id or body_frame
        return [_transform(message.header, child, where.position, where.orientation)]
    return [
        _transform(
            each.header, each.child_frame_id, each.transform.translation, each.transform.rotation
        )
        for each in message.transforms
    ]


def _transform(header: Any, child: str, position: Any, rotation: Any) -> Transform:
    quaternion = rotation.x, rotation.y, rotation.z, rotation.w
    return Transform(
        parent=frame_name(header.frame_id),
        child=frame_name(child),
        stamp_ns=stamp_ns(header),
        pose=Pose((position.x, position.y, position.z), quaternion),
    )
