"""The poses of all scans of a log, as they were corrected last."""

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.pose import pose_matrices, quaternion_of, slerp
from triquad_format.scan_log.reading import Entry
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import LoggedCorrection, LoggedScan


class _Moves(NamedTuple):
    """How a correction moves poses, each in its own frame."""

    stamps_ns: Longs  # [K] rising
    moves: Doubles  # [K, 4, 4] at these times
    first_ns: int
    until_ns: int

    def apply(self, stamps_ns: Longs, poses: Doubles) -> Doubles:
        """Return poses [N, 4, 4] at times [N] as they are after the correction."""
        moved = (stamps_ns >= self.first_ns) & (stamps_ns <= self.until_ns)
        after: Doubles = poses.copy()
        after[moved] = poses[moved] @ _between(self.stamps_ns, self.moves, stamps_ns[moved])
        return after


class SourceTrack:
    """The poses of the scans of one source, in the order of their stamps."""

    def __init__(self) -> None:
        self._new: dict[int, Doubles] = {}  # by stamp, those that came since they were put in order
        self._stamps_ns: Longs = np.zeros(0, np.int64)
        self._poses: Doubles = np.zeros((0, 4, 4))
        self._corrected: _Moves | None = None  # last

    def add(self, stamp_ns: int, pose: Doubles) -> None:
        """Add a pose [4, 4]; one with the same stamp is replaced."""
        self._new[stamp_ns] = pose

    @property
    def stamps_ns(self) -> Longs:
        """The stamps [N] of all poses, rising."""
        self._put_in_order()
        return self._stamps_ns

    @property
    def poses(self) -> Doubles:
        """All poses [N, 4, 4]."""
        self._put_in_order()
        return self._poses

    def pose(self, stamp_ns: int) -> Doubles:
        """Return the pose [4, 4] with a stamp, which must be there."""
        result: Doubles = self.poses[np.searchsorted(self.stamps_ns, stamp_ns)]
        return result

    def covers(self, stamps_ns: Longs) -> Bools:
        """Return at which times [K] its pose is known."""
        if len(self.stamps_ns) == 0:
            return np.zeros(len(stamps_ns), np.bool_)
        known: Bools = (stamps_ns >= self._stamps_ns[0]) & (stamps_ns <= self._stamps_ns[-1])
        return known

    def correct(self, correction: LoggedCorrection) -> None:
        """Move the poses that a correction is about.

        A pose between two of the correction moves, in its own frame, by what lies between their
        moves; after the last one, by that one's.
        """
        stamps, before = self.stamps_ns, self.poses
        known = self.covers(correction.stamps_ns)
        if not known.any():
            return
        given, better = correction.stamps_ns[known], correction.world_from_sensor[known]
        moves = np.linalg.inv(_between(stamps, before, given)) @ better
        first_ns = int(correction.stamps_ns[0])
        self._corrected = _Moves(given, moves, first_ns, correction.until_ns)
        self._poses = self._corrected.apply(stamps, before)

    def add_late(self, stamp_ns: int, pose: Doubles) -> Doubles:
        """Add a pose [4, 4] that came amid the last correction; return it as that moves it."""
        if self._corrected is not None:
            pose = self._corrected.apply(np.array([stamp_ns]), pose[None])[0]
        self.add(stamp_ns, pose)
        return pose

    def _put_in_order(self) -> None:
        if not self._new:
            return
        stamps = np.fromiter(self._new, np.int64, len(self._new))
        kept = ~np.isin(self._stamps_ns, stamps)
        stamps = np.concatenate([self._stamps_ns[kept], stamps])
        poses = np.concatenate([self._poses[kept], np.array(list(self._new.values()))])
        order = np.argsort(stamps)
        self._stamps_ns, self._poses = stamps[order], poses[order]
        self._new.clear()


class SourceTracks(defaultdict[str, SourceTrack]):
    """The tracks of all sources, by name."""

    def __init__(self) -> None:
        super().__init__(SourceTrack)

    def take(self, entry: Entry) -> None:
        """Go on with the next entry of a log: a pose is added, and a correction moves those before.

        A reset moves none.
        """
        if isinstance(entry, LoggedScan):
            self[entry.source].add(entry.stamp_ns, entry.world_from_sensor)
        elif isinstance(entry, Transform):
            self[entry.child].add(entry.stamp_ns, entry.pose)
        elif isinstance(entry, LoggedCorrection):
            self[entry.source].correct(entry)


def _between(stamps_ns: Longs, poses: Doubles, at_ns: Longs) -> Doubles:
    """Return poses [M, 4, 4] at times [M], of poses [N, 4, 4] at rising times [N], one at least.

    Positions are interpolated on straight lines and rotations on great circles (Shoemake 1985);
    before the first and after the last, they are those.
    """
    after = np.clip(np.searchsorted(stamps_ns, at_ns), 0, len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    span_ns = np.maximum(stamps_ns[after] - stamps_ns[before], 1)
    share = np.clip((at_ns - stamps_ns[before]) / span_ns, 0.0, 1.0)[:, None]
    share[after == before] = 0.0
    turns = np.array([quaternion_of(pose[:3, :3]) for pose in poses])
    places = poses[:, :3, 3]
    positions = places[before] + share * (places[after] - places[before])
    return pose_matrices(positions, slerp(turns[before], turns[after], share))
