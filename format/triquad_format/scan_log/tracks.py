"""The poses of all scans of a log, as they were corrected last."""

from collections import defaultdict
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.pose import pose_matrices, quaternion_of, slerp
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import Entry, LoggedCorrection, LoggedScan

_AGAIN_NS = 1_000_000_000
"""Where stamps of a source fall by more, its time began again, as with another start of a robot
whose clock does not go on: the same stamps are those of other scans from then on."""

_TOLERANCE, _AT = 0.02, 40.0
"""A scan has moved if anything within 100 voxels of its sensor has, by a twentieth of a voxel: in
units of how far kept scans are apart."""


class Motion(NamedTuple):
    """The poses of one source, from one time that its time began until it began again."""

    stamps_ns: Longs  # [N] rising
    poses: Doubles  # [N, 4, 4]

    def moves(self, stamps_ns: Longs, poses: Doubles) -> tuple[Longs, Doubles]:
        """Return times [M] and moves [M, 4, 4] there, each in the source's own frame.

        They bring it to ``poses`` [K, 4, 4] at ``stamps_ns`` [K], which rise. Those that do not lie
        amid its own say nothing: where none does, M is 0.
        """
        known = (stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1])
        given, better = stamps_ns[known], poses[known]
        if not len(given):
            return given, better
        moves = np.linalg.inv(_between(self.stamps_ns, self.poses, given)) @ better
        if known[0]:
            return given, moves
        return np.append(stamps_ns[:1], given), np.concatenate([moves[:1], moves])


class LogPoses:
    """The poses of the scans of a log, kept or not, a row each in the order in which they came."""

    def __init__(self, apart_m: float = 0.0) -> None:
        """Begin; kept scans are ``apart_m`` apart: a share of that is how far a scan has moved."""
        self.poses: list[Doubles] = []
        self._apart_m = apart_m
        self._mapped: list[Doubles] = []  # the poses with which they were learnt from
        self._stamps_ns: list[int] = []
        # Of each source, and each time that its time began, the last one last.
        self._rows = defaultdict[str, list[list[int]]](list)

    @property
    def sources(self) -> list[str]:
        """The names of all sources."""
        return sorted(name for name, starts in self._rows.items() if starts)

    def take(self, entry: Entry) -> None:
        """Go on with the next entry of a log: a pose is added, and a correction moves those before.

        A reset moves none.
        """
        if isinstance(entry, LoggedScan):
            self._add(entry, entry.world_from_sensor)
        elif isinstance(entry, Transform):
            self._add(entry, entry.pose)
        elif isinstance(entry, LoggedCorrection):
            self.correct(entry)

    def correct(self, correction: LoggedCorrection) -> dict[int, Doubles]:
        """Move poses; return what those were, by row, from which they have moved by too much.

        Corrections that each move a scan by less add up until they do.
        """
        starts = self._rows[correction.source]
        if correction.since >= len(starts):  # they are kept no more
            return {}
        rows = starts[-1 - correction.since]
        before = np.array([self.poses[row] for row in rows])
        stamps_ns = np.array([self._stamps_ns[row] for row in rows], np.int64)
        after = corrected(correction, stamps_ns, before)
        mapped = np.array([self._mapped[row] for row in rows])
        has_moved = motions(mapped, after, _AT * self._apart_m) > _TOLERANCE * self._apart_m
        moved: dict[int, Doubles] = {}
        for row, pose, was, far in zip(rows, after, mapped, has_moved.tolist(), strict=True):
            self.poses[row] = pose
            if far:
                moved[row], self._mapped[row] = was, pose
        return moved

    def motion(self, source: str, first_ns: int, last_ns: int) -> tuple[Motion, int]:
        """Return the last motion of a source that lies amid two times, or its last one.

        With it comes how often its time began again since.
        """
        motions = [self._motion(rows) for rows in reversed(self._rows[source])]
        for since, one in enumerate(motions):
            if one.stamps_ns[0] <= last_ns and one.stamps_ns[-1] >= first_ns:
                return one, since
        return motions[0], 0

    def of(self, source: str) -> Doubles:
        """Return all poses [N, 4, 4] of a source, in the order in which they came."""
        rows = [row for rows in self._rows[source] for row in rows]
        return np.array([self.poses[row] for row in rows])

    def starts(self, source: str) -> int:
        """Return how often the time of a source began."""
        return len(self._rows[source])

    def _add(self, entry: LoggedScan | Transform, pose: Doubles) -> None:
        starts, stamp_ns = self._rows[source_of(entry)], entry.stamp_ns
        if not starts or stamp_ns < self._stamps_ns[starts[-1][-1]] - _AGAIN_NS:
            starts.append([])
        starts[-1].append(len(self.poses))
        self.poses.append(pose)
        self._mapped.append(pose)
        self._stamps_ns.append(stamp_ns)

    def _motion(self, rows: list[int]) -> Motion:
        stamps_ns = np.array([self._stamps_ns[row] for row in rows], np.int64)
        order = np.argsort(stamps_ns, kind="stable")
        return Motion(stamps_ns[order], np.array([self.poses[row] for row in rows])[order])


def source_of(entry: LoggedScan | Transform) -> str:
    """Return of which source a pose is."""
    return entry.source if isinstance(entry, LoggedScan) else entry.child


def with_pose(entry: LoggedScan | Transform, pose: Doubles) -> LoggedScan | Transform:
    """Return the same with another pose [4, 4]."""
    if isinstance(entry, LoggedScan):
        return replace(entry, world_from_sensor=pose)
    return entry._replace(pose=pose)


def corrected(correction: LoggedCorrection, stamps_ns: Longs, poses: Doubles) -> Doubles:
    """Return poses [N, 4, 4] at times [N] as they are after a correction."""
    moved = (stamps_ns >= correction.stamps_ns[0]) & (stamps_ns <= correction.until_ns)
    after: Doubles = poses.copy()
    moves = _between(correction.stamps_ns, correction.moves, stamps_ns[moved])
    after[moved] = poses[moved] @ moves
    return after


def motions(before: Doubles, after: Doubles, within: float) -> Doubles:
    """Return how far poses [N, 4, 4] move anything ``within`` so far of the sensor, at most."""
    shifts = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    turns = np.linalg.norm(after[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2)
    farthest: Doubles = shifts + within * turns
    return farthest


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
    turns = np.zeros((len(poses), 4))
    used = np.union1d(before, after)  # of others it would take long
    turns[used] = quaternion_of(poses[used, :3, :3])
    places = poses[:, :3, 3]
    positions = places[before] + share * (places[after] - places[before])
    return pose_matrices(positions, slerp(turns[before], turns[after], share))
