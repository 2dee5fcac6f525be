"""The motion of a robot that publishes none: the odometry of its lidar, and places it knows."""

from collections.abc import Iterator

import numpy as np
from triquad_client.pose import Pose
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import quaternion_of

from triquad_tools.odometry.loop_closure import LoopClosure
from triquad_tools.odometry.odometry import Odometry
from triquad_tools.odometry.registration import Registration, library
from triquad_tools.ros2.intake.corrections import BodyPath
from triquad_tools.ros2.intake.scan_publisher import refuse_late
from triquad_tools.ros2.options import BridgeOptions
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.track import STATIC, Transform
from triquad_tools.sensors.reach import reach_m
from triquad_tools.sensors.sweep import NoScanError, NoTransformError, Sweep

_BEGIN_S = 1.0
"""For so long sweeps are gathered, from the first with points on, which tell how far the sensor
sees; by then it is known where it sits on the robot, if that is published at all."""

_FRAME = "triquad_odometry"
"""In which the body moves without jumps. It is moved in the map where a loop is closed, and with it
all sweeps that are not published yet."""


class LiveOdometry:
    """Tells by the clouds of one topic where the robot's body is, in the frame it began in."""

    def __init__(
        self, topic_name: str, frames: FrameTree, options: BridgeOptions, map_frame: str
    ) -> None:
        """``frames`` tell where the sensor sits on the body, if they do.

        Raises:
            ToolError: small_gicp is not installed.
        """
        library()
        self.topic_name = topic_name
        self.body_frame = options.body_frame  # the sensor's, where nothing says where it sits
        self._frames = frames
        self._map_frame = map_frame
        self._closes_loops = options.close_loops
        self._gathered: list[Sweep] = []
        self._odometry: Odometry | None = None
        self._loops: LoopClosure | None = None
        self._sensor_from_body: Doubles = np.eye(4)
        self._newest_ns = self._before_ns = 0  # stamps of the last two

    def take(self, sweep: Sweep) -> Iterator[Transform | BodyPath]:
        """Yield where the body was in a sweep, and in those that were gathered before the first.

        Where it is at a place that it knows, a path follows with where it was by that.

        Raises:
            NoScanError: it does not fit what was seen before, or is of another drive, or it is not
                known where the sensor sat on the body in the first ones.
        """
        self._check_time(sweep.stamp_ns)
        if self._odometry is None:
            if not self._gathered and not sweep.has_points:
                return
            self._gathered.append(sweep)
            if sweep.stamp_ns - self._gathered[0].stamp_ns < _BEGIN_S * 1e9:
                return
            waiting, self._gathered = self._gathered, []
            yield self._begin(waiting)
        else:
            waiting = [sweep]
        for each in waiting:
            yield from self._moved(each)

    def _check_time(self, stamp_ns: int) -> None:
        """Go on to the stamp of a sweep; one wrong stamp far ahead of all others holds up none."""
        refuse_late(self._newest_ns - stamp_ns)
        if stamp_ns < self._before_ns:
            raise NoScanError(
                "restarted",
                "time went back: odometry cannot tell where another drive begins; start "
                "triquad-ros2 again with an empty map",
            )
        self._before_ns = min(self._newest_ns, stamp_ns)
        self._newest_ns = stamp_ns

    def _begin(self, gathered: list[Sweep]) -> Transform:
        """Begin; return where its frame is in the map."""
        frame = gathered[0].frame
        if self.body_frame in self._frames.path(frame):
            self._sensor_from_body = self._mounted(frame, gathered)
        else:
            self.body_frame = frame
        registration = Registration(reach_m([each.points for each in gathered]))
        self._odometry = Odometry(registration)
        self._loops = LoopClosure(registration) if self._closes_loops else None
        return _transform(self._map_frame, _FRAME, STATIC, np.eye(4))

    def _mounted(self, frame: str, gathered: list[Sweep]) -> Doubles:
        """Return the body as the sensor sees it [4, 4], at the newest sweep that has a transform.

        Some robots publish what never moves with all that does, and a little late.
        """
        refusal = None
        for each in reversed(gathered):
            at = np.array([each.stamp_ns], np.int64)
            try:
                return np.array(self._frames.poses(frame, self.body_frame, at)[0])
            except NoTransformError as error:
                refusal = refusal or error
        assert refusal is not None
        raise refusal

    def _moved(self, sweep: Sweep) -> Iterator[Transform | BodyPath]:
        """Yield as :meth:`take`, if the sweep has any points."""
        assert self._odometry is not None
        step = self._odometry.add(sweep)
        if step is None:
            return
        pose = step.pose @ self._sensor_from_body
        yield _transform(_FRAME, self.body_frame, step.stamp_ns, pose)
        if self._loops is not None and self._loops.add(step):
            yield _transform(self._map_frame, _FRAME, STATIC, self._loops.correction)
            stamps_ns, there = self._loops.keyframes()
            # A wrong stamp may have been far ahead.
            rise = stamps_ns <= np.minimum.accumulate(stamps_ns[::-1])[::-1]
            poses = there[rise] @ self._sensor_from_body
            yield BodyPath(self._map_frame, stamps_ns[rise], poses)


def _transform(parent: str, child: str, stamp_ns: int | None, pose: Doubles) -> Transform:
    x, y, z = pose[:3, 3].tolist()
    turn = tuple(quaternion_of(pose[:3, :3]).tolist())
    return Transform(parent, child, stamp_ns, Pose((x, y, z), turn))
