"""Where a lidar was, from scan to scan."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.pose import quaternion_of
from triquad_format.scan_log.segment import LoggedCorrection
from triquad_format.scan_log.tracks import Motion, corrected

from triquad_tools.odometry.loop_closure import LoopClosure
from triquad_tools.odometry.registration import Fit, Registration
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.motion.track import Track
from triquad_tools.sensors.reach import reach_m
from triquad_tools.sensors.sweep import NoScanError, Sweep

_LONGEST = 2.0  # times the last move that is expected of the next, however late it comes
_WELL, _COARSE = 0.9, 4.0
"""A scan of whose points fewer lie in cells seen before is searched for in cells so much larger,
too: a lidar that begins to turn by 7 degrees a scan was lost without that."""

_WORLD = "world"


class Odometry:
    """The way of a lidar so far, and what it has seen.

    Each scan is registered with what those before it have seen, and from time to time with what was
    seen long before.
    """

    def __init__(self, first: list[Sweep], *, close_loops: bool = True) -> None:
        """``first`` are a few sweeps that tell how far the sensor sees.

        Raises:
            ToolError: small_gicp is not installed.
        """
        self._registration = Registration(reach_m([sweep.points for sweep in first]))
        self._seen = self._registration.nothing_seen(forgets=True)
        self._coarse = self._registration.nothing_seen(_COARSE, forgets=True)
        self._loops = LoopClosure(self._registration) if close_loops else None
        self._keyframes: list[int] = []  # numbers of scans
        self._poses: list[Doubles] = []
        self.stamps_ns: list[int] = []
        self.spans_ns: list[int] = []  # when each sweep began and ended
        self.loose: list[int] = []  # numbers of scans that are hardly held along one direction

    @property
    def loops(self) -> int:
        """How many loops were closed."""
        return self._loops.count if self._loops is not None else 0

    @property
    def way_m(self) -> float:
        """How far the sensor went."""
        places = np.array(self._poses).reshape(-1, 4, 4)[:, :3, 3]
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())

    def add(self, sweep: Sweep) -> None:
        """Go on with the next sweep.

        Raises:
            NoScanError: it does not fit what was seen before, and is left out.
        """
        is_known = np.isfinite(sweep.points).all(axis=1)
        if not is_known.any():
            return
        offsets = None if sweep.offsets_s is None else sweep.offsets_s[is_known]
        sweep = replace(sweep, points=sweep.points[is_known], offsets_s=offsets)
        middle_ns = sweep.stamp_ns + (0 if offsets is None else round(1e9 * np.median(offsets)))
        points, pose = self._expected(sweep, middle_ns)
        thinned = self._registration.thinned(points)
        cloud = self._registration.cloud(thinned)
        if self._poses:
            fit = self._fit(cloud, pose)
            if not fit.is_there:
                text = f"{fit.share:.0%} of its points lie where those before it have some"
                raise NoScanError("lost", text)
            if not fit.is_held:
                self.loose.append(len(self._poses))
            pose = fit.pose
        self._seen.insert(cloud, pose)
        self._coarse.insert(cloud, pose)
        if self._loops is not None and self._loops.add(thinned, pose):
            self._keyframes.append(len(self._poses))
        self.stamps_ns.append(middle_ns)
        self._poses.append(pose)
        self.spans_ns += sweep.span_ns

    def _fit(self, cloud: Any, expected: Doubles) -> Fit:
        """Return where a cloud fits: near where it is expected or, if not well, farther away."""
        fit = self._registration.fit(self._seen, cloud, expected)
        if fit.share < _WELL:
            near = self._registration.fit(self._coarse, cloud, expected, _COARSE).pose
            fit = max(fit, self._registration.fit(self._seen, cloud, near), key=lambda f: f.share)
        return fit

    def trajectory(self) -> tuple[Longs, Doubles, float]:
        """Return times [N] and poses there [N, 4, 4], with loops closed; there must be a scan.

        With them comes by how many metres the loops moved them at most.
        """
        stamps_ns, poses = np.array(self.stamps_ns, np.int64), np.array(self._poses)
        moved_m = 0.0
        if self._loops is not None and self._loops.count:
            keyframes_ns = stamps_ns[self._keyframes]
            moves = Motion(stamps_ns, poses).moves(keyframes_ns, self._loops.poses())[1]
            last_ns = max(self.spans_ns)
            better = corrected(LoggedCorrection("", keyframes_ns, moves, last_ns), stamps_ns, poses)
            moved_m = float(np.linalg.norm((better - poses)[:, :3, 3], axis=1).max())
            poses = better
        # The first and the last sweep were not taken at once.
        ends_ns = np.setdiff1d([self.spans_ns[0], self.spans_ns[-1]], stamps_ns)
        ends = [_ahead(stamps_ns, poses, end_ns) for end_ns in ends_ns]
        if ends:
            stamps_ns, poses = np.append(stamps_ns, ends_ns), np.concatenate([poses, ends])
        return stamps_ns, poses, moved_m

    def _expected(self, sweep: Sweep, middle_ns: int) -> tuple[Floats, Doubles]:
        """Return points as seen from one place, and the pose there, if the sensor moves on."""
        if sweep.offsets_s is None:
            return sweep.points, self._ahead(middle_ns)
        track = Track()
        for stamp_ns in (sweep.span_ns[0], middle_ns, sweep.span_ns[1]):
            pose = self._ahead(stamp_ns)
            turn = quaternion_of(pose[:3, :3]).tolist()
            track.add(stamp_ns, pose[:3, 3].tolist(), turn)
        frames = FrameTree().with_track(_WORLD, sweep.frame, track)
        scan = place(sweep, frames, _WORLD)
        return scan.points, scan.world_from_sensor

    def _ahead(self, stamp_ns: int) -> Doubles:
        return _ahead(self.stamps_ns, self._poses, stamp_ns)


def _ahead(
    stamps_ns: Sequence[int] | Longs, poses: Sequence[Doubles] | Doubles, at_ns: int
) -> Doubles:
    """Return the pose [4, 4] at a time, if the sensor moves as it did between two scans."""
    if len(poses) < 2:
        return poses[0] if len(poses) else np.eye(4)
    pair = slice(0, 2) if at_ns < stamps_ns[0] else slice(-2, None)
    (before, after), (before_ns, after_ns) = poses[pair], stamps_ns[pair]
    step = np.linalg.inv(before) @ after
    times = min((at_ns - after_ns) / max(after_ns - before_ns, 1), _LONGEST)
    further = np.eye(4)
    turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
    further[:3, :3] = Rotation.from_rotvec(times * turn).as_matrix()
    further[:3, 3] = times * step[:3, 3]
    pose: Doubles = after @ further
    return pose
