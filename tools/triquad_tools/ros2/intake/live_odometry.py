"""The motion of a robot that publishes none: the odometry of its lidar."""

from collections.abc import Iterator

import numpy as np
from triquad_client.pose import Pose
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import quaternion_of

from triquad_tools.odometry.odometry import Odometry
from triquad_tools.odometry.registration import Registration, library
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.track import Transform
from triquad_tools.sensors.reach import reach_m
from triquad_tools.sensors.sweep import NoScanError, NoTransformError, Sweep

_BEGIN_S = 1.0
"""For so long sweeps are gathered, from the first with points on, which tell how far the sensor
sees; by then it is known where it sits on the robot, if that is published at all."""


class LiveOdometry:
    """Tells by the clouds of one topic where the robot's body is in the frame it began in."""

    def __init__(self, topic_name: str, frames: FrameTree, body_frame: str, map_frame: str) -> None:
        """``frames`` tell where the sensor sits on ``body_frame``, if they do.

        Raises:
            ToolError: small_gicp is not installed.
        """
        library()
        self.topic_name = topic_name
        self._frames = frames
        self._body_frame = body_frame
        self._map_frame = map_frame
        self._gathered: list[Sweep] = []
        self._odometry: Odometry | None = None
        self._sensor_from_body: Doubles = np.eye(4)
        self._newest_ns = 0

    def take(self, sweep: Sweep) -> Iterator[Transform]:
        """Yield where the body was in a sweep, and in those that were gathered before the first.

        Raises:
            NoScanError: it does not fit what was seen before, or is of another drive, or it is not
                known where the sensor sat on the body in the first ones.
        """
        if sweep.stamp_ns < self._newest_ns:
            raise NoScanError(
                "restarted",
                "time went back: odometry cannot tell where another drive begins; start "
                "triquad-ros2 again with an empty map",
            )
        self._newest_ns = sweep.stamp_ns
        if self._odometry is None:
            if not self._gathered and not sweep.has_points:
                return
            self._gathered.append(sweep)
            if sweep.stamp_ns - self._gathered[0].stamp_ns < _BEGIN_S * 1e9:
                return
            waiting, self._gathered = self._gathered, []
            self._begin(waiting)
        else:
            waiting = [sweep]
        for each in waiting:
            yield from self._moved(each)

    def _begin(self, gathered: list[Sweep]) -> None:
        frame = gathered[0].frame
        if self._body_frame in self._frames.path(frame):
            self._sensor_from_body = self._mounted(frame, gathered)
        else:
            self._body_frame = frame
        self._odometry = Odometry(Registration(reach_m([each.points for each in gathered])))

    def _mounted(self, frame: str, gathered: list[Sweep]) -> Doubles:
        """Return the body as the sensor sees it [4, 4], at the newest sweep that has a transform.

        Some robots publish what never moves with all that does, and a little late.
        """
        refusal = None
        for each in reversed(gathered):
            at = np.array([each.stamp_ns], np.int64)
            try:
                return np.array(self._frames.poses(frame, self._body_frame, at)[0])
            except NoTransformError as error:
                refusal = refusal or error
        assert refusal is not None
        raise refusal

    def _moved(self, sweep: Sweep) -> Iterator[Transform]:
        """Yield where the body was when half of a sweep was taken, if it has any points."""
        assert self._odometry is not None
        step = self._odometry.add(sweep)
        if step is None:
            return
        pose = step.pose @ self._sensor_from_body
        x, y, z = pose[:3, 3].tolist()
        turn = tuple(quaternion_of(pose[:3, :3]).tolist())
        yield Transform(self._map_frame, self._body_frame, step.stamp_ns, Pose((x, y, z), turn))
