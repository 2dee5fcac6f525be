"""Where a lidar was, from scan to scan."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.pose import quaternion_of

from triquad_tools.odometry.registration import Fit, Registration
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.motion.track import Track
from triquad_tools.sensors.sweep import NoScanError, Sweep

_LONGEST = 2.0  # times the last move that is expected of the next, however late it comes
_WELL, _COARSE = 0.9, 4.0
"""A scan of whose points fewer lie in cells seen before is searched for in cells so much larger,
too: lidars that begin to turn by 7 degrees a scan were lost without that."""

_WORLD = "world"


class Step(NamedTuple):
    """Where a lidar was when half of a sweep was taken."""

    stamp_ns: int
    pose: Doubles  # [4, 4] as seen from where the first sweep was taken
    thinned: Floats  # [N, 3] some points of the sweep, as seen from there
    is_held: bool  # whether something holds it along every direction


class Odometry:
    """Registers each sweep of a lidar with what those before it have seen."""

    def __init__(self, registration: Registration) -> None:
        self._registration = registration
        self._seen = registration.nothing_seen(forgets=True)
        self._coarse = registration.nothing_seen(_COARSE, forgets=True)
        self._steps: list[Step] = []  # the last two

    def add(self, sweep: Sweep) -> Step | None:
        """Go on with the next sweep; ``None``: it has no points.

        Raises:
            NoScanError: it does not fit what was seen before, and is left out.
        """
        is_known = np.isfinite(sweep.points).all(axis=1)
        if not is_known.any():
            return None
        offsets = None if sweep.offsets_s is None else sweep.offsets_s[is_known]
        sweep = replace(sweep, points=sweep.points[is_known], offsets_s=offsets)
        middle_ns = sweep.stamp_ns + (0 if offsets is None else round(1e9 * np.median(offsets)))
        points, pose = self._expected(sweep, middle_ns)
        thinned = self._registration.thinned(points)
        cloud, is_held = self._registration.cloud(thinned), True
        if self._steps:
            fit = self._fit(cloud, pose)
            if not fit.is_there:
                text = f"{fit.share:.0%} of its points lie where those before it have some"
                raise NoScanError("lost", text)
            pose, is_held = fit.pose, fit.is_held
        self._seen.insert(cloud, pose)
        self._coarse.insert(cloud, pose)
        step = Step(middle_ns, pose, thinned, is_held)
        self._steps = [*self._steps[-1:], step]
        return step

    def _fit(self, cloud: Any, expected: Doubles) -> Fit:
        """Return where a cloud fits: near where it is expected or, if not well, farther away."""
        fit = self._registration.fit(self._seen, cloud, expected)
        if fit.share >= _WELL:
            return fit
        near = self._registration.fit(self._coarse, cloud, expected, _COARSE).pose
        other = self._registration.fit(self._seen, cloud, near)
        return max(fit, other, key=lambda each: each.share)

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
        """Return the pose [4, 4] at a time, if the sensor moves as it did between two sweeps."""
        if len(self._steps) < 2:
            return self._steps[0].pose if self._steps else np.eye(4)
        before, after = self._steps
        times = (stamp_ns - after.stamp_ns) / max(after.stamp_ns - before.stamp_ns, 1)
        return moved_on(before.pose, after.pose, min(times, _LONGEST))


def moved_on(before: Doubles, after: Doubles, times: float) -> Doubles:
    """Return the pose [4, 4] that goes on from another, ``times`` as far as that from its last."""
    step, further = np.linalg.inv(before) @ after, np.eye(4)
    turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
    further[:3, :3] = Rotation.from_rotvec(times * turn).as_matrix()
    further[:3, 3] = times * step[:3, 3]
    pose: Doubles = after @ further
    return pose
