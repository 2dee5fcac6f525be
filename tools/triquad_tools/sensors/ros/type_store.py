"""Decoding messages of ROS, whose types are known by their names alone."""

from functools import cache
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from triquad_tools.sensors.sweep import NoScanError

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF = "tf2_msgs/msg/TFMessage"
TF_OF_ROS_1 = "tf/msg/tfMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
MARKER = "visualization_msgs/msg/Marker"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"


@cache
def type_store() -> Typestore:
    """Return the types of ROS 2; those used here are the same in all releases."""
    return get_typestore(Stores.LATEST)


def decode_cdr(payload: bytes, type_name: str) -> Any:
    """Return the message of its bytes, as ROS 2 sends them.

    Raises:
        NoScanError: they are no such message.
    """
    try:
        return type_store().deserialize_cdr(payload, type_name)
    # Any error of the decoder: bytes of another type lead it anywhere.
    except (SerdeError, ValueError, IndexError, MemoryError, TypeError) as error:
        raise NoScanError("decode", f"no {type_name}: {error}") from error
