"""Where a lidar was, by its clouds alone.

Each scan is registered with what those before it have seen, as Gaussians in cells (VGICP: Koide et
al., ICRA 2021), by small_gicp.
"""

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.pose import quaternion_of

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.arguments import WORLD
from triquad_tools.recordings.cloud import reach_m
from triquad_tools.recordings.folders.trajectory import Trajectory, timed
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.motion.track import Track
from triquad_tools.sensors.sweep import Sweep

_FIRST = 8  # sweeps, which tell how far the sensor sees
_RANGES = 2.0  # times what 95 % of the points are within, up to which points are used
_NEAREST_M, _FARTHEST_M = 10.0, 100.0  # of these ranges
_CELLS, _POINTS = 50, 200
"""Cells of what was seen, and of the points of a scan that are used, to the largest range.

Streets with 16 to 128 beams and rooms drift by 0.3 % of the way at most; with cells half as large,
those with few beams by 8 %, with twice as many points by 10 %."""

_LOST = 0.65
"""The share of a scan's points that lie in cells seen before, below which it is somewhere else: it
was 0.75 at least where the way was right, and 0.6 at most in some scan where it was not."""

_HELD = 0.06
"""How well a scan is held along one direction, as a share of another, below which it may have slid:
0.12 at least on streets and in rooms, 0.02 in a tunnel."""

_LONGEST = 2.0  # times the last move that is expected of the next, however late it comes


def find_trajectory(sweeps: Iterable[Sweep], count: int) -> Trajectory:
    """Return where a sensor was, as seen from where it was at first.

    Args:
        sweeps: of one sensor, in the order of their stamps.
        count: how many they are.

    Raises:
        ToolError: small_gicp is not installed, there are no points, or a scan does not fit those
            before it.
    """
    try:
        import small_gicp
    except ModuleNotFoundError as error:
        raise ToolError("--odometry needs small_gicp: pip install 'triquad[tools]'") from error
    sweeps = iter(sweeps)
    first = list(islice(sweeps, _FIRST))
    range_m = _RANGES * reach_m([sweep.points for sweep in first])
    way = _Way(small_gicp, float(np.clip(range_m, _NEAREST_M, _FARTHEST_M)))
    with progress("odometry", count) as report:
        for number, sweep in enumerate(chain(first, sweeps), start=1):
            way.add(number, sweep)
            report(number, f"{number} of {count} scans")
    return way.trajectory(count)


class _Way:
    """The way of a sensor so far, and what it has seen."""

    def __init__(self, library: ModuleType, range_m: float) -> None:
        self._library = library
        self._range_m = range_m
        self._seen = library.GaussianVoxelMap(range_m / _CELLS)
        self._stamps_ns: list[int] = []
        self._poses: list[Doubles] = []
        self._spans_ns: list[int] = []  # when each sweep began and ended
        self._free: list[int] = []  # numbers of scans that are hardly held along one direction

    def add(self, number: int, sweep: Sweep) -> None:
        """Add a sweep, or raise a ToolError: it does not fit what was seen before."""
        is_known = np.isfinite(sweep.points).all(axis=1)
        if not is_known.any():
            return
        offsets = None if sweep.offsets_s is None else sweep.offsets_s[is_known]
        sweep = replace(sweep, points=sweep.points[is_known], offsets_s=offsets)
        middle_ns = sweep.stamp_ns + (0 if offsets is None else round(1e9 * np.median(offsets)))
        points, pose = self._expected(sweep, middle_ns)
        near = points[np.linalg.norm(points, axis=1) < self._range_m].astype(np.float64)
        cloud = self._library.preprocess_points(near, self._range_m / _POINTS)[0]
        if self._poses:
            pose = self._registered(number, cloud, pose)
        self._seen.insert(cloud, pose)
        self._stamps_ns.append(middle_ns)
        self._poses.append(pose)
        self._spans_ns += sweep.span_ns

    def _expected(self, sweep: Sweep, middle_ns: int) -> tuple[Floats, Doubles]:
        """Return points as seen from one place, and the pose there, if the sensor moves on."""
        if sweep.offsets_s is None:
            return sweep.points, self._ahead(middle_ns)
        track = Track()
        for stamp_ns in (sweep.span_ns[0], middle_ns, sweep.span_ns[1]):
            pose = self._ahead(stamp_ns)
            turn = quaternion_of(pose[:3, :3]).tolist()
            track.add(stamp_ns, pose[:3, 3].tolist(), turn)
        frames = FrameTree().with_track(WORLD, sweep.frame, track)
        scan = place(sweep, frames, WORLD)
        return scan.points, scan.world_from_sensor

    def _ahead(self, stamp_ns: int) -> Doubles:
        """Return the pose [4, 4] at a time, if the sensor moves as it did between two scans."""
        if len(self._poses) < 2:
            return self._poses[0] if self._poses else np.eye(4)
        pair = slice(0, 2) if stamp_ns < self._stamps_ns[0] else slice(-2, None)
        (before, after), (before_ns, after_ns) = self._poses[pair], self._stamps_ns[pair]
        step = np.linalg.inv(before) @ after
        times = min((stamp_ns - after_ns) / max(after_ns - before_ns, 1), _LONGEST)
        further = np.eye(4)
        turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
        further[:3, :3] = Rotation.from_rotvec(times * turn).as_matrix()
        further[:3, 3] = times * step[:3, 3]
        pose: Doubles = after @ further
        return pose

    def _registered(self, number: int, cloud: Any, expected: Doubles) -> Doubles:
        """Return the pose at which a cloud fits what was seen."""
        reach = 2 * self._range_m / _CELLS
        found = self._library.align(self._seen, cloud, expected, max_correspondence_distance=reach)
        share = found.num_inliers / max(cloud.size(), 1)
        if share < _LOST:
            raise ToolError(
                f"--odometry lost its way at scan {number}: {share:.0%} of its points lie where "
                "those before it have some: the sensor moves too far from one to the next (map all "
                "of them), or sees too little; or give its poses"
            )
        held = np.linalg.eigvalsh(found.H[3:, 3:])
        if held[0] < _HELD * held[2]:
            self._free.append(number)
        pose: Doubles = found.T_target_source
        return pose

    def trajectory(self, count: int) -> Trajectory:
        """Return the way, with its trust as remarks.

        Raises:
            ToolError: no scan has any points.
        """
        if not self._poses:
            raise ToolError("--odometry: no scan has any points")
        stamps_ns, poses = self._stamps_ns, self._poses
        # The first and the last sweep were not taken at once.
        ends = {self._spans_ns[0], self._spans_ns[-1]}.difference(stamps_ns)
        of_all = np.array([*stamps_ns, *ends], np.int64)
        found = timed(
            Path("odometry"), "VGICP", np.array([*poses, *map(self._ahead, ends)]), of_all
        )
        way_m = np.linalg.norm(np.diff(np.array(poses)[:, :3, 3], axis=0), axis=1).sum()
        remarks = [
            f"poses are those of odometry, along {way_m:.1f} m: it drifts, and closes no loop"
        ]
        if self._free:
            remarks.append(
                f"{len(self._free)} of {count} scans, from number {self._free[0]} on, see hardly "
                "anything that holds them along one direction, as in a tunnel: the way may be "
                "wrong there, too short above all"
            )
        return replace(found, remarks=tuple(remarks))
