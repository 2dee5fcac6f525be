"""The poses of a source's scans: as the server has them, and as a SLAM has them by now."""

from collections import deque
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.pose import pose_matrices, quaternion_of, slerp
from triquad_format.scan_log.segment import LoggedCorrection
from triquad_format.scan_log.tracks import Motion, corrected, motions
from triquad_format.wire.limits import MAX_KEYFRAMES

MOVED_M, AT_M = 0.05, 10.0
"""A scan is corrected if anything within 10 m of its sensor moves by as much, a quarter of a voxel:
a SLAM moves all that it knows a little with each message, and each correction costs seconds."""

APART_M = 0.1
"""The way after which the pose of another scan is kept: those between move with it. The newest
50,000 are kept, of 5 km at least."""

_RECENT = 200  # scans, 20 s at 10 Hz: a path waits for a correction that is under way

_JUMPS = 50  # of which the times are kept

_NEW = 1000  # poses that wait, at most, to be put among the others


class Poses(NamedTuple):
    """Poses at some times."""

    stamps_ns: Longs  # [K] rising
    world_from_sensor: Doubles  # [K, 4, 4]


class Jump(NamedTuple):
    """A move of the frame in which odometry goes on, where a SLAM has closed a loop."""

    until_ns: int  # when the frame was last where it had been
    move: Doubles  # [4, 4] of what was in the map before

    def parts(self, shares: Doubles, place: Doubles) -> Doubles:
        """Return shares [N] of the move as moves [N, 4, 4]; it turns about a place [3]."""
        about, back = np.eye(4), np.eye(4)
        about[:3, 3], back[:3, 3] = place, -place
        local = back @ self.move @ about
        turns = slerp(
            np.tile(quaternion_of(np.eye(3)), (len(shares), 1)),
            np.tile(quaternion_of(local[:3, :3]), (len(shares), 1)),
            shares[:, None],
        )
        return about @ pose_matrices(shares[:, None] * local[:3, 3], turns) @ back


class SourcePoses:
    """The poses of the scans of one source; a scan that was published last comes last."""

    def __init__(self) -> None:
        self._recent = deque[tuple[int, Doubles]](maxlen=_RECENT)
        self._kept: Doubles | None = None  # the one that was kept last
        self._stamps_ns: Longs = np.zeros(0, np.int64)  # [N] rising, of those that are kept
        self._served: Doubles = np.zeros((0, 4, 4))  # [N, 4, 4] where the server has them
        self._wanted = self._served
        self._jumps_ns: list[int] = []  # when the newest jumps were
        self._new: list[tuple[int, Doubles]] = []  # that are not among these yet

    @property
    def newest_ns(self) -> int:
        """The stamp of the newest scan; there must be one."""
        return self._recent[-1][0]

    def add(self, stamp_ns: int, pose: Doubles) -> None:
        """Add a scan with its pose [4, 4]."""
        self._recent.append((stamp_ns, pose))
        if self._kept is None or motions(self._kept[None], pose[None], AT_M)[0] > APART_M:
            self._kept = pose
            self._keep(stamp_ns, pose)

    def follow(self, path: Poses, until_ns: int) -> bool:
        """Want scans up to a time where the sensor's ``path`` has them, and after it as its end.

        Returns whether the path has a time amid the scans.
        """
        self._put_in_order()
        stamps_ns = path.stamps_ns[path.stamps_ns <= until_ns]
        poses = path.world_from_sensor[: len(stamps_ns)]
        motion = Motion(self._stamps_ns, self._wanted)
        stamps_ns, moves = motion.moves(stamps_ns, poses)
        if not len(moves):
            return False
        correction = LoggedCorrection("", stamps_ns, moves, until_ns)
        wanted = corrected(correction, self._stamps_ns, self._wanted)
        if len(self._moved(wanted)):
            self._keep_end(until_ns)
            wanted = corrected(correction, self._stamps_ns, self._wanted)
        self._wanted = wanted
        return True

    def jump(self, jump: Jump) -> None:
        """Want scans moved by a jump, each by the share of the way since the jump before.

        Jumps that follow each other within 10 m of way are one, in parts.
        """
        self._put_in_order()
        self._keep_end(jump.until_ns)
        stamps_ns, places = self._stamps_ns, self._wanted[:, :3, 3]
        way_m = np.cumsum(np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1))
        last = int(np.searchsorted(stamps_ns, jump.until_ns, side="right")) - 1
        if last < 0:
            return
        rows = np.searchsorted(stamps_ns, self._jumps_ns, side="right")
        before = [int(row) for row in rows if way_m[last] - way_m[max(row - 1, 0)] > AT_M]
        moved = slice(max(before, default=0), last + 1)
        begin_m = way_m[moved.start]
        share = (way_m[moved] - begin_m) / max(way_m[last] - begin_m, 1e-9)
        self._wanted[moved] = jump.parts(share, places[last]) @ self._wanted[moved]
        self._jumps_ns = [*self._jumps_ns[-_JUMPS:], jump.until_ns]

    def to_correct(self) -> Poses | None:
        """Return where scans should be, from the first to the last that are not there; None: none.

        Those between them that stay hold others in place.
        """
        self._put_in_order()
        moved = self._moved(self._wanted)
        if len(moved) == 0:
            return None
        some = slice(moved[0], moved[-1] + 1)
        return Poses(self._stamps_ns[some], self._wanted[some])

    def corrected(self, poses: Poses) -> None:
        """Record that the server has scans where :meth:`to_correct` said."""
        there = np.isin(self._stamps_ns, poses.stamps_ns)
        self._served[there] = poses.world_from_sensor[np.isin(poses.stamps_ns, self._stamps_ns)]

    def _keep_end(self, until_ns: int) -> None:
        """Keep the last scan up to a time, and the first after it.

        What lies between a scan that moves and one that stays would move halfway.
        """
        at = sum(stamp_ns <= until_ns for stamp_ns, _ in self._recent)
        for stamp_ns, pose in list(self._recent)[max(at - 1, 0) : at + 1]:
            if stamp_ns not in self._stamps_ns:
                self._keep(stamp_ns, pose)
        self._put_in_order()

    def _keep(self, stamp_ns: int, pose: Doubles) -> None:
        """Keep the pose of a scan, as it was published."""
        self._new.append((stamp_ns, pose))
        if len(self._new) >= _NEW:
            self._put_in_order()

    def _put_in_order(self) -> None:
        """Have the new ones among the others; where these are too many, the newer half stays."""
        if not self._new:
            return
        stamps_ns, poses = (np.array(each) for each in zip(*self._new, strict=True))
        self._new.clear()
        stamps_ns = np.append(self._stamps_ns, stamps_ns)
        order = np.argsort(stamps_ns, kind="stable")
        order = order[-MAX_KEYFRAMES // 2 :] if len(order) > MAX_KEYFRAMES else order
        self._stamps_ns = stamps_ns[order]
        self._served = np.concatenate([self._served, poses])[order]
        self._wanted = np.concatenate([self._wanted, poses])[order]

    def _moved(self, wanted: Doubles) -> Longs:
        """Return which of the kept scans the server does not have where they are wanted."""
        moved: Longs = np.flatnonzero(motions(self._served, wanted, AT_M) > MOVED_M)
        return moved
