"""The motion of one frame in another: poses at times, and between them."""

from array import array
from bisect import bisect_left

import numpy as np
from triquad_client.pose import pose_matrices
from triquad_format.records.arrays import Doubles, Longs

from triquad_tools.sensors.sweep import NoTransformError

MAX_GAP_S = 2.0
"""Nothing is interpolated between poses that lie farther apart."""

_WIDTH = 7  # numbers of a pose
_NEARLY_PARALLEL = 0.9995  # quaternions, of which spherical interpolation would divide by nearly 0


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

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first stamp and the last, of a track that has poses."""
        return self._stamps[0], self._stamps[-1]

    def add(self, stamp_ns: int, position_m: Doubles, quaternion: Doubles) -> None:
        """Add a pose, position [3] and unit quaternion [4]; one with the same stamp is replaced."""
        at = bisect_left(self._stamps, stamp_ns)
        replaced = at < len(self._stamps) and self._stamps[at] == stamp_ns
        if not replaced:
            self._stamps.insert(at, stamp_ns)
        end = at + 1 if replaced else at
        self._values[_WIDTH * at : _WIDTH * end] = array("d", [*position_m, *quaternion])
        if self._limit is not None and len(self._stamps) > self._limit:
            del self._stamps[0], self._values[:_WIDTH]

    def poses(self, stamps_ns: Longs) -> Doubles:
        """Return poses [M, 4, 4] at times [M].

        Raises:
            NoTransformError: a time lies before the first pose, after the last, or in a gap.
        """
        self._check_covered(stamps_ns)
        stamps, values = self._around(int(stamps_ns.min()), int(stamps_ns.max()))
        after = np.clip(np.searchsorted(stamps, stamps_ns), 1, len(stamps) - 1)
        if len(stamps) == 1:
            after = np.zeros_like(after)
        before = np.maximum(after - 1, 0)
        self._check_gaps(stamps_ns, stamps[before], stamps[after])
        span = np.maximum(stamps[after] - stamps[before], 1)
        share = ((stamps_ns - stamps[before]) / span)[:, None]
        first, second = values[before], values[after]
        positions = first[:, :3] + share * (second[:, :3] - first[:, :3])
        return pose_matrices(positions, _slerp(first[:, 3:], second[:, 3:], share))

    def _around(self, first_ns: int, last_ns: int) -> tuple[Longs, Doubles]:
        """Return stamps [K] and values [K, 7] of the poses between two times, and around them."""
        low = max(0, bisect_left(self._stamps, first_ns) - 1)
        high = bisect_left(self._stamps, last_ns) + 1
        values = np.array(self._values[_WIDTH * low : _WIDTH * high], np.float64)
        return np.array(self._stamps[low:high], np.int64), values.reshape(-1, _WIDTH)

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
            raise NoTransformError(
                "pose_gap", f"between two poses {gaps_s.max():.3g} s apart (at most {MAX_GAP_S:g})"
            )


def _slerp(first: Doubles, second: Doubles, share: Doubles) -> Doubles:
    """Interpolate between unit quaternions [M, 4], by the shorter way."""
    cosine = (first * second).sum(axis=1, keepdims=True)
    second = np.where(cosine < 0, -second, second)
    cosine = np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, _NEARLY_PARALLEL))
    of_first = np.where(cosine < _NEARLY_PARALLEL, np.sin((1 - share) * angle), 1 - share)
    of_second = np.where(cosine < _NEARLY_PARALLEL, np.sin(share * angle), share)
    between = of_first * first + of_second * second
    turned: Doubles = between / np.linalg.norm(between, axis=1, keepdims=True)
    return turned
