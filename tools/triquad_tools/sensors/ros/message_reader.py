"""Messages of ROS, recorded or as they arrive, turned into sweeps and transforms."""

import math
import sys
from dataclasses import dataclass, field, replace
from typing import Any

from triquad_client.pose import Pose

from triquad_tools.sensors.motion.track import STATIC, Transform
from triquad_tools.sensors.ros import type_store as types
from triquad_tools.sensors.ros.depth_camera import camera_topic, sweep_of_depth
from triquad_tools.sensors.ros.point_cloud import sweep_of_cloud
from triquad_tools.sensors.ros.type_store import frame_name, stamp_ns
from triquad_tools.sensors.sweep import NoScanError, Sweep


@dataclass(frozen=True)
class MessageReader:
    """Reads decoded messages; remembers the cameras, which depth images need."""

    units_per_metre: float | None = None  # of depth images; else as REP 118 has them
    stride: int = 1  # every how many rows and columns of a depth image one is taken
    body_frame: str = ""  # whose poses are those that do not say whose they are
    deskew: bool = True  # take the sensor's motion out of clouds whose points have times
    by_arrival: bool = False  # stamps are when messages came, not those of their headers
    max_points: float = math.inf  # of a scan; what has more is refused
    path_poses: int = sys.maxsize  # of a path, the newest that are read
    cameras: dict[str, Any] = field(default_factory=dict)  # CameraInfo by its topic

    def sweep(self, topic: str, kind: str, message: Any, came_ns: int) -> Sweep:
        """Return the sweep of a cloud or a depth image.

        Raises:
            NoScanError: it is none, or has too many points, or its camera is not known.
        """
        if isinstance(message, Sweep):
            sweep = message
            self._check_count(len(sweep.points))
        elif kind == types.POINT_CLOUD:
            self._check_count(message.width * message.height)
            sweep = sweep_of_cloud(message)
        else:
            stride, info = self.stride, self._camera(camera_topic(topic))
            self._check_count(-(-info.width // stride) * -(-info.height // stride))
            sweep = sweep_of_depth(message, info, topic, stride, self.units_per_metre)
        if sweep.offsets_s is not None and not self.deskew:
            sweep = replace(sweep, offsets_s=None, note="point times are not used")
        return replace(sweep, stamp_ns=came_ns) if self.by_arrival else sweep

    def transforms(
        self, kind: str, message: Any, came_ns: int, *, static: bool = False
    ) -> list[Transform]:
        """Return the transforms of a message of transforms, ``static`` or not, or of a pose."""
        found = self._transforms(kind, message)
        if static:
            return [replace(each, stamp_ns=STATIC) for each in found]
        return [replace(each, stamp_ns=came_ns) for each in found] if self.by_arrival else found

    def _transforms(self, kind: str, message: Any) -> list[Transform]:
        if kind in (*types.TRANSFORMS, types.TRANSFORM):
            stamped = [message] if kind == types.TRANSFORM else message.transforms
            return [
                _transform(s, s.child_frame_id, s.transform.translation, s.transform.rotation)
                for s in stamped
            ]
        if kind == types.PATH:
            body = self.body_frame
            found = [_posed(each, body, each.pose) for each in message.poses[-self.path_poses :]]
            frame = frame_name(message.header.frame_id)
            return [replace(each, parent=each.parent or frame) for each in found]
        if kind == types.POSE:
            return [_posed(message, self.body_frame, message.pose)]
        child = message.child_frame_id if kind == types.ODOMETRY else ""
        return [_posed(message, child or self.body_frame, message.pose.pose)]

    def _camera(self, topic: str) -> Any:
        if topic not in self.cameras:
            there = ", ".join(sorted(self.cameras)) or "none"
            raise NoScanError(
                "no_camera_info",
                f"nothing is known of the camera of {topic} (of that kind there is {there}): it "
                "has to be published and recorded",
            )
        return self.cameras[topic]

    def _check_count(self, points: int) -> None:
        if points > self.max_points:
            raise NoScanError(
                "too_many_points",
                f"{points} points exceed {self.max_points}: publish smaller clouds, or, of depth "
                "images, raise --depth-stride",
            )


def _posed(message: Any, child: str, pose: Any) -> Transform:
    return _transform(message, child, pose.position, pose.orientation)


def _transform(message: Any, child: str, position: Any, rotation: Any) -> Transform:
    quaternion = rotation.x, rotation.y, rotation.z, rotation.w
    pose = Pose((position.x, position.y, position.z), quaternion)
    parent = frame_name(message.header.frame_id)
    return Transform(parent, frame_name(child), stamp_ns(message.header), pose)
