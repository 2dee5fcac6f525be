"""Jumps of the frame of odometry in the map, by which a SLAM closes a loop."""

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import pose_matrices
from triquad_format.scan_log.tracks import motions

from triquad_tools.ros2.intake.source_poses import AT_M, Jump
from triquad_tools.sensors.motion.track import STATIC, Transform

_JUMP_M = 0.2
"""What moves anything within 10 m of the robot by less is how a SLAM follows it, scan by scan: each
scan was placed with it already."""


_ODOMETRY = "odom"  # REP 105; behind the name of a robot, too


class FrameJumps:
    """Finds where the frame of odometry jumps in the map frame, among transforms as they come."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, Doubles]] = {}  # when and where each such frame was last

    def add(self, transform: Transform, map_from_robot: Doubles) -> Jump | None:
        """Go on with a transform from the map frame; return the jump that it ends, if it does.

        ``map_from_robot`` [4, 4] is where the robot was last.
        """
        frame, stamp_ns = transform.child, transform.stamp_ns
        if stamp_ns is STATIC or frame.rpartition("/")[2] != _ODOMETRY:
            return None
        now = pose_matrices(*(np.array([part]) for part in transform.numbers()))[0]
        before_ns, before = self._last.get(frame, (stamp_ns, now))
        self._last[frame] = stamp_ns, now
        move = now @ np.linalg.inv(before)
        moved_m = motions(map_from_robot[None], (move @ map_from_robot)[None], AT_M)[0]
        # Where time goes back, another drive begins.
        return Jump(before_ns, move) if moved_m > _JUMP_M and before_ns <= stamp_ns else None
