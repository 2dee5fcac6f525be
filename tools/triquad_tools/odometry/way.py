"""The whole way of a lidar, with its loops closed."""

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.scan_log.segment import LoggedCorrection
from triquad_format.scan_log.tracks import Motion, corrected

from triquad_tools.odometry.loop_closure import LoopClosure
from triquad_tools.odometry.odometry import Odometry, moved_on
from triquad_tools.odometry.registration import Registration
from triquad_tools.sensors.sweep import Sweep


class Way:
    """Where a lidar was at each of its sweeps."""

    def __init__(self, reach_m: float, *, close_loops: bool = True) -> None:
        """``reach_m`` is within how many metres nearly all points are.

        Raises:
            ToolError: small_gicp is not installed.
        """
        registration = Registration(reach_m)
        self._odometry = Odometry(registration)
        self._loops = LoopClosure(registration) if close_loops else None
        self._stamps_ns: list[int] = []
        self._poses: list[Doubles] = []  # [4, 4] as odometry has them
        self._span_ns: tuple[int, int] | None = None  # from the first point of all to the last
        self.loose: list[int] = []  # numbers of sweeps that are hardly held along one direction
        self.moved_m = 0.0  # how far :meth:`trajectory` has moved a pose by loops, at most

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def loops(self) -> int:
        """How many loops were closed."""
        return self._loops.count if self._loops is not None else 0

    @property
    def length_m(self) -> float:
        """How far the sensor went."""
        places = np.array(self._poses).reshape(-1, 4, 4)[:, :3, 3]
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())

    def add(self, sweep: Sweep) -> None:
        """Go on with the next sweep; one without points is left out.

        Raises:
            NoScanError: it does not fit what was seen before, and is left out.
        """
        step = self._odometry.add(sweep)
        if step is None:
            return
        if not step.is_held:
            self.loose.append(len(self))
        if self._loops is not None:
            self._loops.add(step)
        self._stamps_ns.append(step.stamp_ns)
        self._poses.append(step.pose)
        first_ns, last_ns = sweep.span_ns
        self._span_ns = (first_ns if self._span_ns is None else self._span_ns[0], last_ns)

    def trajectory(self) -> tuple[Longs, Doubles]:
        """Return rising times [N] and the poses there [N, 4, 4]; there must be a sweep."""
        stamps_ns, poses = np.array(self._stamps_ns, np.int64), np.array(self._poses)
        assert self._span_ns is not None
        if self._loops is not None and self._loops.count:
            self._loops.close()
            keyframes_ns, there = self._loops.keyframes()
            moves = Motion(stamps_ns, poses).moves(keyframes_ns, there)[1]
            correction = LoggedCorrection("", keyframes_ns, moves, self._span_ns[1])
            closed = corrected(correction, stamps_ns, poses)
            self.moved_m = float(np.linalg.norm((closed - poses)[:, :3, 3], axis=1).max())
            poses = closed
        return _to_ends(stamps_ns, poses, self._span_ns)


def _to_ends(stamps_ns: Longs, poses: Doubles, span_ns: tuple[int, int]) -> tuple[Longs, Doubles]:
    """Return a way that goes on to when its first and its last point were measured."""
    for first, other, at in ((0, min(1, len(poses) - 1), 0), (-1, -min(2, len(poses)), len(poses))):
        end_ns, since_ns = span_ns[first], int(stamps_ns[first] - stamps_ns[other])
        if end_ns == stamps_ns[first]:
            continue
        times = (end_ns - stamps_ns[first]) / since_ns if since_ns else 0.0
        end = moved_on(poses[other], poses[first], times)
        at = at and len(poses)
        stamps_ns, poses = np.insert(stamps_ns, at, end_ns), np.insert(poses, at, end, axis=0)
    return stamps_ns, poses
