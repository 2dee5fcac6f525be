"""Bags as robots record them, written with rosbags."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores
from support.ros_messages import CLOUD, ODOMETRY, TF, RosMessages

BagKind = Literal["mcap", "sqlite3", "ros1"]
KINDS: tuple[BagKind, ...] = ("mcap", "sqlite3", "ros1")


class Recorded(NamedTuple):
    """A message, and when it was recorded."""

    topic: str
    type_name: str
    recorded_ns: int
    message: Any


def messages_for(kind: BagKind) -> RosMessages:
    """What builds messages for bags of a kind."""
    return RosMessages(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)


def write_bag(path: Path, kind: BagKind, messages: Iterable[Recorded]) -> Path:
    """Write a bag: a file of ROS 1, or a folder of ROS 2."""
    ros = messages_for(kind)
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer: Any = Ros1Writer(path)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    connections: dict[str, Any] = {}
    with writer:
        for topic, type_name, recorded_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=ros.types)
            writer.write(connections[topic], recorded_ns, ros.encode(message, type_name))
    return path


def drive(
    ros: RosMessages,
    scans: Sequence[NDArray[np.float32]],
    poses: NDArray[np.float64],
    stamps_ns: Sequence[int],
    base_from_lidar: NDArray[np.float64],
    pose_kind: Literal["tf", "odometry"] = "tf",
) -> list[Recorded]:
    """What a robot records whose lidar ``lidar`` sits on ``base_link``, which moves in ``odom``."""
    static = ros.tf(0, ("base_link", "lidar", base_from_lidar))
    recorded = [Recorded("/tf_static", TF, int(stamps_ns[0]) - 10**8, static)]
    lidar_from_base = np.linalg.inv(base_from_lidar)
    for points, pose, stamp in zip(scans, poses, map(int, stamps_ns), strict=True):
        recorded.append(Recorded("/lidar/points", CLOUD, stamp + 1, ros.cloud(points, stamp)))
        body = pose @ lidar_from_base
        if pose_kind == "tf":
            message = ros.tf(stamp, ("odom", "base_link", body))
            recorded.append(Recorded("/tf", TF, stamp + 2, message))
        else:
            message = ros.odometry(stamp, body, "odom", "base_link")
            recorded.append(Recorded("/odom", ODOMETRY, stamp + 2, message))
    return recorded
