"""Jumps of the frame of odometry in the map, where a SLAM closes a loop."""

from collections import deque
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import pose_matrices
from triquad_format.scan_log.tracks import motions

from triquad_tools.ros2.intake.source_poses import AT_M, Jump
from triquad_tools.sensors.motion.track import STATIC, Transform

_JUMP_M = 0.2
"""What moves anything within 10 m of the robot by less is how a SLAM follows it, scan by scan: each
scan was placed with it already."""

_SLIP = 1 / 3
"""The share of the robot's motion since the SLAM moved the frame last, so measured and within 10 m,
up to which it follows, too: tracks slip when they turn, and slam_toolbox waits for half a radian.
Taken for loops, turns 10 % off moved scans that were right by 0.5 m on average, in simulation."""

_STILL_M = 1e-6  # a frame that moves by less was only published again

_ODOMETRY = "odom"  # REP 105; behind the name of a robot, too


class _Frame(NamedTuple):
    stamp_ns: int
    map_from_frame: Doubles  # [4, 4]
    robot: Doubles | None  # [4, 4] where it was in the frame when that moved last, if it did


class FrameJumps:
    """Finds where the frame of odometry jumps in the map frame, among transforms as they come."""

    def __init__(self, wait_s: float) -> None:
        """Jumps are due after a while: until then scans of before may be published."""
        self._wait_s = wait_s
        self._last: dict[str, _Frame] = {}  # by the name of each such frame
        self._found = deque[tuple[float, Jump]]()  # and when each is due

    def due(self, now_s: float) -> list[Jump]:
        """Take the jumps that are due; another thread than that of :meth:`add` may."""
        jumps = []
        while self._found and self._found[0][0] <= now_s:
            jumps.append(self._found.popleft()[1])
        return jumps

    def add(self, transform: Transform, map_from_robot: Doubles, now_s: float) -> None:
        """Go on with a transform from the map frame, which may end a jump.

        ``map_from_robot`` [4, 4] is where the robot was last.
        """
        jump = self._ended(transform, map_from_robot)
        if jump is not None:
            self._found.append((now_s + self._wait_s, jump))

    def _ended(self, transform: Transform, map_from_robot: Doubles) -> Jump | None:
        name, stamp_ns = transform.child, transform.stamp_ns
        if stamp_ns is STATIC or name.rpartition("/")[2] != _ODOMETRY:
            return None
        now = pose_matrices(*(np.array([part]) for part in transform.numbers()))[0]
        before = self._last.get(name)
        if before is None or stamp_ns < before.stamp_ns:  # another drive begins
            self._last[name] = _Frame(stamp_ns, now, None)
            return None
        robot = np.linalg.inv(before.map_from_frame) @ map_from_robot
        move = now @ np.linalg.inv(before.map_from_frame)
        moved_m = motions(map_from_robot[None], (move @ map_from_robot)[None], AT_M)[0]
        since = robot if moved_m > _STILL_M else before.robot
        self._last[name] = _Frame(stamp_ns, now, since)
        slip_m = 0.0
        if before.robot is not None:
            driven_m = motions(before.robot[None], robot[None], AT_M)[0]
            slip_m = _SLIP * driven_m if driven_m < AT_M else 0.0
        return Jump(before.stamp_ns, move) if moved_m > max(_JUMP_M, slip_m) else None
