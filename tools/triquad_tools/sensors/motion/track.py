"""The pose of one frame in another as robots report it, and over time with what lies between."""

import math
from array import array
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from triquad_client.pose import Pose
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.plausibility import JUMP_M, jumps
from triquad_format.records.pose import pose_matrices, slerp

from triquad_tools.sensors.sweep import NoTransformError

STATIC = None  # the stamp of a transform that always holds
MAX_GAP_S = 2.0  # between poses farther apart nothing is interpolated, unless they only correct
_NEARLY_UNIT = 1e-6  # the length of a quaternion that is left as it is
_WIDTH = 7  # numbers of a pose
_RARER = 3.0  # times, at least, is a correction rarer than the poses that it corrects
_CORRECTED_M, _CORRECTED_RAD = 0.3, 0.05  # drift; a correction by more, at a loop, comes at once


@dataclass(frozen=True)
class Transform:
    """The pose of a frame in its parent."""

    parent: str
    child: str
    stamp_ns: int | None  # nanoseconds since 1970, or STATIC
    pose: Pose

    def numbers(self) -> tuple[Sequence[float], Sequence[float]]:
        """Return the position [3] and the unit quaternion [4].

        Raises:
            InvalidScanError: its pose is none.
        """
        position, turn = self.pose.position_m, self.pose.quaternion_xyzw
        if (
            isinstance(position, tuple)  # as transforms come, a thousand a second
            and isinstance(turn, tuple)
            and abs(math.hypot(*turn) - 1) < _NEARLY_UNIT
            and math.isfinite(sum(position))
        ):
            return position, turn
        checked = self.pose.numbers()
        return checked[0].tolist(), checked[1].tolist()


class Track:
    """The poses of a frame in its parent, in the order of their stamps.

    Positions are interpolated on straight lines and rotations on great circles (Shoemake 1985).
    Nothing is extrapolated.
    """

    def __init__(self, limit: int | None = None) -> None:
        """Only the ``limit`` newest poses are kept."""
        self._limit = limit
        self._stamps = array("q")
        self._values = array("d")  # position and unit quaternion of each
        self._length_m = 0.0  # of the way, also of poses that are kept no longer
        self._replaced = 0  # poses, by others elsewhere at the same time

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first stamp and the last, of a track that has poses."""
        return self._stamps[0], self._stamps[-1]

    @property
    def rate_hz(self) -> float:
        """How many poses there are a second; 0 of a single one."""
        first, last = self.span_ns if self._stamps else (0, 0)
        return (len(self) - 1) / (last - first) * 1e9 if last > first else 0.0

    @property
    def longest_gap_s(self) -> float:
        """The longest time between two poses."""
        return float(np.diff(np.array(self._stamps, np.int64)).max(initial=0)) / 1e9

    def corrects(self, below: "Track") -> bool:
        """Return whether it is rarer than the motion below it, and moves no more than that."""
        is_rare = self.rate_hz * _RARER <= below.rate_hz
        return is_rare and self._length_m <= below._length_m + 1.0

    def add(self, stamp_ns: int, position_m: Sequence[float], quaternion: Sequence[float]) -> None:
        """Add a pose, position [3] and unit quaternion [4]; one with the same stamp is replaced."""
        stamps, values = self._stamps, self._values
        if stamps and stamp_ns <= stamps[-1]:
            at = bisect_left(stamps, stamp_ns)
            replaced = stamps[at] == stamp_ns
            if replaced:
                before = values[_WIDTH * at : _WIDTH * at + 3]
                self._replaced += math.dist(before, position_m) > JUMP_M
            else:
                stamps.insert(at, stamp_ns)
            new = array("d", [*position_m, *quaternion])
            values[_WIDTH * at : _WIDTH * (at + replaced)] = new
        else:  # as nearly all do
            self._length_m += math.dist(values[-_WIDTH:-4], position_m) if stamps else 0.0
            stamps.append(stamp_ns)
            values.extend(position_m)
            values.extend(quaternion)
        if self._limit is not None and len(self._stamps) > self._limit:
            del self._stamps[0], self._values[:_WIDTH]

    def jumps(self) -> tuple[int, float]:
        """Return how often it jumps to and fro as if two published it, and by how much, metres."""
        places = np.array(self._values).reshape(-1, _WIDTH)[:, :3]
        return jumps(np.array(self._stamps, np.int64), places, self._replaced)

    def poses(self, stamps_ns: Longs, *, corrects: bool = False) -> Doubles:
        """Return poses [M, 4, 4] at times [M].

        Those that only correct others stay as they were, until the next one, where they come
        less than once a second; and in gaps, unless they moved by no more than drift does.

        Raises:
            NoTransformError: a time lies before the first pose, after the last, or in a gap.
        """
        stays = corrects and len(self) > 0 and self.rate_hz < 1.0
        self._check_covered(np.minimum(stamps_ns, self.span_ns[1]) if stays else stamps_ns)
        low = max(0, bisect_left(self._stamps, int(stamps_ns.min())) - 1)
        high = bisect_left(self._stamps, int(stamps_ns.max())) + 1
        stamps = np.array(self._stamps[low:high], np.int64)
        values = np.array(self._values[_WIDTH * low : _WIDTH * high]).reshape(-1, _WIDTH)
        after = np.clip(np.searchsorted(stamps, stamps_ns), 1, len(stamps) - 1)
        if len(stamps) == 1:
            after = np.zeros_like(after)
        before = np.maximum(after - 1, 0)
        span = np.maximum(stamps[after] - stamps[before], 1)
        share = np.minimum((stamps_ns - stamps[before]) / span, 1.0)[:, None]
        first, second = values[before], values[after]
        if corrects:
            cosine = np.abs((first[:, 3:] * second[:, 3:]).sum(axis=1))
            turned = 2 * np.arccos(np.clip(cosine, 0, 1)) > _CORRECTED_RAD
            moved = np.linalg.norm(second[:, :3] - first[:, :3], axis=1) > _CORRECTED_M
            jumps = (span > MAX_GAP_S * 1e9) & (moved | turned)
            share = np.where(jumps[:, None] & (share < 1), 0.0, share)
        else:
            self._check_gaps(stamps_ns, stamps[before], stamps[after])
        positions = first[:, :3] + share * (second[:, :3] - first[:, :3])
        return pose_matrices(positions, slerp(first[:, 3:], second[:, 3:], share))

    def _check_covered(self, stamps_ns: Longs) -> None:
        if not self._stamps:
            raise NoTransformError("no_poses", "there are no poses", late=True)
        first, last = self.span_ns
        if stamps_ns.max() > last:
            late_s = (int(stamps_ns.max()) - last) / 1e9
            raise NoTransformError("pose_late", f"{late_s:.3g} s after the last pose", late=True)
        if stamps_ns.min() < first:
            early_s = (first - int(stamps_ns.min())) / 1e9
            raise NoTransformError("pose_early", f"{early_s:.3g} s before the first pose")

    @staticmethod
    def _check_gaps(stamps_ns: Longs, before: Longs, after: Longs) -> None:
        between = (stamps_ns != before) & (stamps_ns != after)
        gaps_s = np.where(between, after - before, 0) / 1e9
        if gaps_s.max() > MAX_GAP_S:
            text = f"between two poses {gaps_s.max():.3g} s apart (at most {MAX_GAP_S:g})"
            raise NoTransformError("pose_gap", text)
