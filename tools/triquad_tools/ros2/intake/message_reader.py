"""Messages of ROS, as they arrived, turned into sweeps and transforms."""

from dataclasses import replace
from typing import Any

from triquad_tools.ros2.intake.message_queue import Arrival
from triquad_tools.ros2.options import ScanOptions
from triquad_tools.ros2.topic_choice import Role
from triquad_tools.sensors.errors import NoScanError
from triquad_tools.sensors.motion.frame_tree import STATIC, Transform
from triquad_tools.sensors.ros.depth_camera import camera_topic, sweep_of_depth
from triquad_tools.sensors.ros.point_cloud import sweep_of_cloud
from triquad_tools.sensors.ros.transforms import (
    transform_of_odometry,
    transform_of_pose,
    transforms_of_tf,
)
from triquad_tools.sensors.ros.type_store import (
    CAMERA_INFO,
    IMAGE,
    ODOMETRY,
    POINT_CLOUD,
    POSE,
    TF,
    decode_cdr,
)
from triquad_tools.sensors.sweep import Sweep

MAX_POINTS = 2_500_000
"""Points of a scan at most: a message of 30 MB, which servers receive with default settings."""


class MessageReader:
    """Reads messages; remembers the cameras, which depth images need."""

    def __init__(self, options: ScanOptions) -> None:
        self._options = options
        self._cameras: dict[str, Any] = {}  # CameraInfo by its topic

    def sweep(self, arrival: Arrival) -> Sweep:
        """Return the sweep of a cloud or a depth image.

        Raises:
            NoScanError: it is none, or has too many points, or its camera is not known.
        """
        payload = arrival.payload.to_bytes()
        if arrival.role is Role.CLOUD:
            message = decode_cdr(payload, POINT_CLOUD)
            _check_count(message.width * message.height)
            sweep = sweep_of_cloud(message)
        else:
            sweep = self._of_depth(decode_cdr(payload, IMAGE), camera_topic(arrival.topic_name))
        return replace(sweep, stamp_ns=arrival.arrived_ns) if self._options.by_arrival else sweep

    def transforms(self, arrival: Arrival) -> list[Transform]:
        """Return the transforms of a message of transforms or of a pose.

        Raises:
            NoScanError: it is none.
        """
        payload = arrival.payload.to_bytes()
        if arrival.role is Role.POSE:
            found = [self._pose(payload)]
        else:
            static = arrival.role is Role.TF_STATIC
            found = transforms_of_tf(decode_cdr(payload, TF), static=static)
        if not self._options.by_arrival:
            return found
        return [
            each if each.stamp_ns is STATIC else replace(each, stamp_ns=arrival.arrived_ns)
            for each in found
        ]

    def remember_camera(self, arrival: Arrival) -> None:
        """Remember a CameraInfo.

        Raises:
            NoScanError: it is none.
        """
        self._cameras[arrival.topic_name] = decode_cdr(arrival.payload.to_bytes(), CAMERA_INFO)

    def _of_depth(self, message: Any, info_topic: str) -> Sweep:
        stride = self._options.depth_stride
        _check_count(-(-message.width // stride) * -(-message.height // stride))
        if info_topic not in self._cameras:
            raise NoScanError(
                "no_camera_info",
                f"nothing came on {info_topic} yet, which tells how the camera sees: it has to "
                "publish there",
            )
        return sweep_of_depth(message, self._cameras[info_topic], stride)

    def _pose(self, payload: bytes) -> Transform:
        """Return the pose of either type: the bytes of one cannot be read as the other."""
        body = self._options.body_frame
        try:
            found = transform_of_odometry(decode_cdr(payload, ODOMETRY))
        except NoScanError:
            return transform_of_pose(decode_cdr(payload, POSE), body)
        return found if found.child else replace(found, child=body)


def _check_count(points: int) -> None:
    if points > MAX_POINTS:
        raise NoScanError(
            "too_many_points",
            f"{points} points exceed {MAX_POINTS}: publish smaller clouds, or, of depth images, "
            "raise --depth-stride",
        )
