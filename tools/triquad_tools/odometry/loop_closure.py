"""Loops: places that a lidar comes back to, and its way with these loops closed."""

from functools import lru_cache
from typing import Any

import numpy as np
from triquad_format.records.arrays import Doubles, Floats

from triquad_tools.odometry.pose_chain import Loop, closed, is_news, surprise
from triquad_tools.odometry.registration import Registration

_APART = 1 / 25
"""Between two keyframes, as a share of the range up to which points are used."""

_SUBMAP = 1 / 4  # of that range, along the way before and after a keyframe: what is fitted to
_NEAR = 1 / 4  # of that range: as far as this from a keyframe it is tried whether it is there
_SCALES = 4.0, 2.0, 1.0  # of cells: with the largest, loops were found that were 10 m off

_SURPRISE = 10.0
"""Standard deviations of the way from which on a loop is none: right ones were 8 off at most, with
16 beams; another floor of a house that looks alike was 12."""

_MOST = 300  # loops; where there are more, every second one stays
_KEPT = 64  # clouds with Gaussians, 2 MB each


class LoopClosure:
    """The keyframes of a way, and the loops among them."""

    def __init__(self, registration: Registration) -> None:
        self._registration = registration
        self._apart_m = _APART * registration.range_m
        self._odometry: list[Doubles] = []  # [4, 4] of each keyframe
        self._way_m: list[float] = []  # to each
        self._points: list[Floats] = []
        self._closed: Doubles = np.zeros((0, 4, 4))  # the poses of keyframes as they are by now
        self._loops: list[Loop] = []
        self._apart_loops = 1  # keyframes
        self._cloud = lru_cache(_KEPT)(self._make_cloud)

    @property
    def count(self) -> int:
        """The number of loops."""
        return len(self._loops)

    def add(self, thinned: Floats, pose: Doubles) -> bool:
        """Add a scan; return whether it is a keyframe: it is far enough from the one before.

        Args:
            thinned: its points [M, 3], sensor frame.
            pose: [4, 4] as odometry has it.
        """
        step_m = 0.0
        if self._odometry:
            step_m = float(np.linalg.norm(pose[:3, 3] - self._odometry[-1][:3, 3]))
            if step_m < self._apart_m:
                return False
        self._way_m.append(step_m + (self._way_m[-1] if self._way_m else 0.0))
        before = self._odometry[-1] if self._odometry else pose
        last = self._closed[-1] if len(self._closed) else before
        self._closed = np.concatenate([self._closed, (last @ np.linalg.inv(before) @ pose)[None]])
        self._odometry.append(pose)
        self._points.append(thinned)
        self._close(len(self._odometry) - 1)
        return True

    def poses(self) -> Doubles:
        """Return the poses [K, 4, 4] of the keyframes, with all loops closed."""
        if self._loops:
            self._closed = closed(np.array(self._odometry), self._loops)
        return self._closed

    def _close(self, after: int) -> None:
        """Find out whether the newest keyframe is where an earlier one was."""
        if self._loops and after - self._loops[-1].after < self._apart_loops:
            return
        before = self._near(after)
        if before is None:
            return
        loop = self._fitted(before, after)
        if loop is None or surprise(self._closed, loop) > _SURPRISE:
            return
        self._loops.append(loop)
        if len(self._loops) > _MOST:
            del self._loops[::2]
            self._apart_loops *= 2
        if is_news(self._closed, loop):
            self.poses()

    def _near(self, after: int) -> int | None:
        """Return the nearest keyframe that lies a whole range back along the way."""
        range_m, way_m = self._registration.range_m, np.array(self._way_m)
        away_m = np.linalg.norm(self._closed[:, :3, 3] - self._closed[after, :3, 3], axis=1)
        away_m[way_m[after] - way_m < range_m] = np.inf
        nearest = int(away_m.argmin())
        return nearest if away_m[nearest] < _NEAR * range_m else None

    def _fitted(self, before: int, after: int) -> Loop | None:
        """Return the loop from a keyframe to another, if that fits what was seen there."""
        registration, cloud = self._registration, self._cloud(after)
        pose = np.linalg.inv(self._closed[before]) @ self._closed[after]
        for scale in _SCALES:
            fit = registration.fit(self._submap(before, scale), cloud, pose, scale)
            pose = fit.pose
        return Loop(before, after, pose) if fit.is_there and fit.is_held else None

    def _submap(self, keyframe: int, scale: float) -> Any:
        """Return what was seen around a keyframe, in its frame, as odometry has it."""
        way_m = np.array(self._way_m)
        along_m = np.abs(way_m - way_m[keyframe])
        seen = self._registration.nothing_seen(scale)
        here = np.linalg.inv(self._odometry[keyframe])
        for other in np.flatnonzero(along_m <= _SUBMAP * self._registration.range_m):
            seen.insert(self._cloud(int(other)), here @ self._odometry[other])
        return seen

    def _make_cloud(self, keyframe: int) -> Any:
        return self._registration.cloud(self._points[keyframe])
