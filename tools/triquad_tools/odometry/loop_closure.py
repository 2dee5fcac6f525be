"""Loops: places that a lidar comes back to, and its way with these loops closed."""

from functools import lru_cache
from typing import Any

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs

from triquad_tools.odometry.odometry import Step
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
_MOST_PLACES = 4000  # whose points are kept, 0.2 MB each: 16 km of a lidar that sees 50 m far


class LoopClosure:
    """The keyframes of a way, and the loops among them."""

    def __init__(self, registration: Registration) -> None:
        self._registration = registration
        self._apart_m = _APART * registration.range_m
        self._stamps_ns: list[int] = []  # of each keyframe
        self._odometry: list[Doubles] = []  # its pose [4, 4]
        self._way_m: list[float] = []  # to it
        self._points: dict[int, Floats] = {}  # of those at places that were not known before
        self._closed: Doubles = np.zeros((0, 4, 4))  # the poses of keyframes as they are by now
        self._loops: list[Loop] = []
        self._apart_loops = 1  # keyframes
        self._cloud = lru_cache(_KEPT)(self._make_cloud)

    @property
    def count(self) -> int:
        """The number of loops."""
        return len(self._loops)

    @property
    def correction(self) -> Doubles:
        """The move [4, 4] of poses of odometry to where they are now; there must be a keyframe."""
        correction: Doubles = self._closed[-1] @ np.linalg.inv(self._odometry[-1])
        return correction

    def add(self, step: Step) -> bool:
        """Add a scan; return whether by it those before lie elsewhere: a loop was closed."""
        step_m, pose = 0.0, step.pose
        if self._odometry:
            step_m = float(np.linalg.norm(pose[:3, 3] - self._odometry[-1][:3, 3]))
            if step_m < self._apart_m:
                return False
        self._way_m.append(step_m + (self._way_m[-1] if self._way_m else 0.0))
        here = self.correction @ pose if self._odometry else pose
        self._closed = np.concatenate([self._closed, here[None]])
        self._stamps_ns.append(step.stamp_ns)
        self._odometry.append(pose)
        after = len(self._odometry) - 1
        self._points[after] = step.thinned
        if len(self._points) > _MOST_PLACES:
            del self._points[min(self._points)]
        before = self._near(after)
        return before is not None and self._comes_back(before, after)

    def close(self) -> None:
        """Have the keyframes where they are with all loops closed, also those that say little."""
        if self._loops:
            self._closed = closed(np.array(self._odometry), self._loops)

    def keyframes(self) -> tuple[Longs, Doubles]:
        """Return the stamps [K] of the keyframes, and where they are by now [K, 4, 4]."""
        return np.array(self._stamps_ns, np.int64), self._closed

    def _comes_back(self, before: int, after: int) -> bool:
        """Find out whether the newest keyframe is where an earlier one was; return as add."""
        moves, is_known = False, self._is_soon(after)
        if not is_known:
            loop = self._fitted(before, after)
            if loop is not None and surprise(self._closed, loop) <= _SURPRISE:
                moves, is_known = is_news(self._closed, loop), True
                self._take(loop)
                if moves:
                    self.close()
        away_m = np.linalg.norm(self._closed[after, :3, 3] - self._closed[before, :3, 3])
        if is_known and away_m < self._apart_m:
            del self._points[after]
        return moves

    def _is_soon(self, after: int) -> bool:
        """Return whether the last loop is too near for another."""
        return bool(self._loops) and after - self._loops[-1].after < self._apart_loops

    def _take(self, loop: Loop) -> None:
        self._loops.append(loop)
        if len(self._loops) > _MOST:
            del self._loops[::2]
            self._apart_loops *= 2

    def _near(self, after: int) -> int | None:
        """Return the nearest keyframe with points that lies a whole range back along the way."""
        range_m, way_m = self._registration.range_m, np.array(self._way_m)
        places = np.array(list(self._points))
        places = places[way_m[after] - way_m[places] >= range_m]
        if not len(places):
            return None
        away_m = np.linalg.norm(self._closed[places, :3, 3] - self._closed[after, :3, 3], axis=1)
        nearest = int(away_m.argmin())
        return int(places[nearest]) if away_m[nearest] < _NEAR * range_m else None

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
        for other in np.flatnonzero(along_m <= _SUBMAP * self._registration.range_m).tolist():
            if other in self._points:
                seen.insert(self._cloud(other), here @ self._odometry[other])
        return seen

    def _make_cloud(self, keyframe: int) -> Any:
        return self._registration.cloud(self._points[keyframe])
