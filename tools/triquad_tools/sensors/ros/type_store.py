"""Messages of ROS: their names, times and types."""

import re
from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
LIVOX = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
CLOUDS = (*LIVOX, POINT_CLOUD)
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGES = (IMAGE, COMPRESSED_IMAGE)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ALL_TF = "tf"  # stands for them in place of a topic of poses, whatever their topics
TF = "tf2_msgs/msg/TFMessage"
TF_OF_ROS_1 = "tf/msg/tfMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
PATH = "nav_msgs/msg/Path"
POSES = (ODOMETRY, POSE_WITH_COVARIANCE, POSE, TRANSFORM, PATH)
TRANSFORMS = (TF, TF_OF_ROS_1)
MARKER = "visualization_msgs/msg/Marker"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"

_MAX_CHARACTERS = 64  # of the name of a source


@cache
def type_store() -> Typestore:
    """Return the types of ROS 2; those used here are the same in all releases."""
    return get_typestore(Stores.LATEST)


def frame_name(name: str) -> str:
    """Return a frame's name without the leading slash that ROS 1 wrote."""
    return name.lstrip("/")


def stamp_ns(header: Any) -> int:
    """Return the header's time, nanoseconds since 1970."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def source_of_topic(topic: str) -> str:
    """Return the source name of a topic's scans: ``/lidar/points`` is ``lidar.points``."""
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", topic.strip("/").replace("/", "."))
    return re.sub(r"^[^A-Za-z0-9]+", "", name)[:_MAX_CHARACTERS] or "default"
