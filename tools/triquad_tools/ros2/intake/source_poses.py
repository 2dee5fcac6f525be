"""The poses of a source's scans: as the server has them, and as a SLAM has them by now."""

from collections import deque
from copy import copy
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.scan_log.segment import LoggedCorrection
from triquad_format.scan_log.tracks import SourceTrack
from triquad_format.wire.limits import MAX_KEYFRAMES

MOVED_M, AT_M = 0.05, 10.0
"""A scan is corrected if anything within 10 m of its sensor moves by as much, a quarter of a voxel:
a SLAM moves all that it knows a little with each message, and each correction costs seconds."""

APART_M = 0.1
"""The way after which the pose of another scan is kept: those between move with it. The newest
50,000 are kept, of 5 km at least."""

_RECENT = 200  # scans, 20 s at 10 Hz: a path waits for a correction that is under way


class Poses(NamedTuple):
    """Poses at some times."""

    stamps_ns: Longs  # [K] rising
    world_from_sensor: Doubles  # [K, 4, 4]


class SourcePoses:
    """The poses of the scans of one source; a scan that was published last comes last."""

    def __init__(self) -> None:
        self._recent = deque[tuple[int, Doubles]](maxlen=_RECENT)
        self._kept: Doubles | None = None  # the one that was kept last
        self._served, self._wanted = SourceTrack(), SourceTrack()  # at the same times
        self._count = 0  # of these

    @property
    def newest_ns(self) -> int:
        """The stamp of the newest scan; there must be one."""
        return self._recent[-1][0]

    def add(self, stamp_ns: int, pose: Doubles) -> None:
        """Add a scan with its pose [4, 4]."""
        self._recent.append((stamp_ns, pose))
        if self._kept is None or _motions_m(self._kept[None], pose[None])[0] > APART_M:
            self._kept = pose
            self._keep(stamp_ns, pose)

    def follow(self, path: Poses, until_ns: int) -> bool:
        """Want scans up to a time where the sensor's ``path`` has them, and after it as its end.

        Returns whether the path has a time amid the scans.
        """
        stamps_ns = path.stamps_ns[path.stamps_ns <= until_ns]
        if not self._wanted.covers(stamps_ns).any():
            return False
        poses = path.world_from_sensor[: len(stamps_ns)]
        correction = LoggedCorrection("", stamps_ns, poses, until_ns)
        wanted = self._corrected(correction)
        if len(self._moved(wanted)):
            # What lies between a scan that moves and one that stays moves halfway: so the last that
            # moves is kept, and the first that stays.
            at = sum(stamp_ns <= until_ns for stamp_ns, _ in self._recent)
            for stamp_ns, pose in list(self._recent)[max(at - 1, 0) : at + 1]:
                if stamp_ns not in self._served.stamps_ns:
                    self._keep(stamp_ns, pose)
            wanted = self._corrected(correction)
        self._wanted = wanted
        return True

    def to_correct(self) -> Poses | None:
        """Return where scans should be, from the first to the last that are not there; None: none.

        Those between them that stay hold others in place.
        """
        moved = self._moved(self._wanted)
        if len(moved) == 0:
            return None
        some = slice(moved[0], moved[-1] + 1)
        return Poses(self._wanted.stamps_ns[some], self._wanted.poses[some])

    def corrected(self, poses: Poses) -> None:
        """Record that the server has scans where :meth:`to_correct` said."""
        for stamp_ns, pose in zip(poses.stamps_ns.tolist(), poses.world_from_sensor, strict=True):
            self._served.add(stamp_ns, pose)

    def _keep(self, stamp_ns: int, pose: Doubles) -> None:
        """Keep the pose of a scan, as it was published."""
        self._count += 1
        if self._count > MAX_KEYFRAMES:
            self._served, self._wanted = _newer(self._served), _newer(self._wanted)
            self._count = len(self._served.stamps_ns) + 1
        self._served.add(stamp_ns, pose)
        self._wanted.add(stamp_ns, pose)

    def _corrected(self, correction: LoggedCorrection) -> SourceTrack:
        """Return where a correction has the kept scans."""
        track = copy(self._wanted)
        track.correct(correction)
        return track

    def _moved(self, wanted: SourceTrack) -> Longs:
        """Return which of the kept scans the server does not have where they are wanted."""
        moved: Longs = np.flatnonzero(_motions_m(self._served.poses, wanted.poses) > MOVED_M)
        return moved


def _newer(track: SourceTrack) -> SourceTrack:
    """Return the newer half of a track."""
    newer = SourceTrack()
    half = len(track.stamps_ns) // 2
    for stamp_ns, pose in zip(track.stamps_ns[half:].tolist(), track.poses[half:], strict=True):
        newer.add(stamp_ns, pose)
    return newer


def _motions_m(before: Doubles, after: Doubles) -> Doubles:
    """Return how far poses [N, 4, 4] move what is near the sensor, at most, metres."""
    moves = np.linalg.inv(before) @ after
    shifts = np.linalg.norm(moves[:, :3, 3], axis=1)
    turns = np.linalg.norm(moves[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2)
    motions: Doubles = shifts + AT_M * turns
    return motions
