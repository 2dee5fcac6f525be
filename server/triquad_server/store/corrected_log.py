"""The scans that were kept, with corrected poses, from the first one that moves."""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.mapfile.checkpoint_folder import CheckpointFile, checkpoint_files
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.scan_log.log_folder import Segment, history, of_map, segments
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import (
    Entry,
    LoggedCorrection,
    LoggedReset,
    LoggedScan,
    read_segment,
)
from triquad_format.scan_log.tracks import LogPoses, corrected, source_of, with_pose
from triquad_format.wire.status_messages import KeptScans

from triquad_server.store.store import Store

_SAME = 1e-9  # of numbers of a pose: rounding moves nothing


class WantedPoses(NamedTuple):
    """Better poses of a source, in the coordinates of who gave them."""

    source: str
    stamps_ns: Longs  # [K] rising, nanoseconds since 1970
    world_from_sensor: Doubles  # [K, 4, 4]


@dataclass(frozen=True)
class CorrectedLog:
    """What regions of a map are to be made of again."""

    correction: LoggedCorrection
    start: int  # of the source's times, from 0 on: whose scans move
    base: CheckpointFile | None  # from which it goes on; None: it begins with nothing
    files: list[Segment]  # of the log, with all that came after that
    first_row: int  # with which these begin
    poses: LogPoses
    before: dict[int, Doubles]  # poses [4, 4] of the scans that move, by row, as they were
    came: list[Entry] = field(default_factory=list)  # meanwhile, with corrected poses

    def moves(self) -> Iterator[LoggedScan | Transform]:
        """Yield the scans that move, each as it was and as it is.

        Raises:
            FormatError: a file is damaged.
            OSError: it cannot be read.
        """
        last = max(self.before)
        for row, entry in self._logged():
            if row > last:
                return
            if row in self.before and isinstance(entry, LoggedScan | Transform):
                yield with_pose(entry, self.before[row])
                yield with_pose(entry, self.poses.poses[row])

    def entries(self) -> Iterator[Entry]:
        """Yield kept scans, with corrected poses, and resets, in their order, then what came late.

        Errors are those of :meth:`moves`.
        """
        for row, entry in self._logged():
            if isinstance(entry, LoggedScan):
                yield with_pose(entry, self.poses.poses[row])
            elif isinstance(entry, LoggedReset):
                yield entry
        yield from self.came

    def late(self, entry: Entry) -> Entry:
        """Return what came meanwhile as the log will have it: before the correction, so it moves.

        What does not is returned as it is. The poses and the entries have it, too, from then on.
        """
        source = self.correction.source
        self.poses.take(entry)
        if (
            isinstance(entry, LoggedScan | Transform)
            and source_of(entry) == source
            and self.poses.starts(source) - 1 == self.start
        ):
            before = self.poses.poses[-1]
            after = corrected(self.correction, np.array([entry.stamp_ns]), before[None])[0]
            if not np.allclose(after, before, rtol=0.0, atol=_SAME):
                self.poses.poses[-1], entry = after, with_pose(entry, after)
        self.came.append(entry)
        return entry

    def logged(self) -> LoggedCorrection:
        """Return the correction as it stands in the log after what came meanwhile."""
        since = self.poses.starts(self.correction.source) - 1 - self.start
        return replace(self.correction, since=since)

    def _logged(self) -> Iterator[tuple[int, Entry]]:
        """Yield what the files have, as it stands there, each with the row of the next pose."""
        row = self.first_row
        for segment in self.files:
            for entry in read_segment(segment.path):
                yield row, entry
                row += isinstance(entry, LoggedScan | Transform)


def corrected_log(
    store: Store, newest: int, wanted: WantedPoses, *, onward: bool
) -> CorrectedLog | None:
    """Return the log of a store, up to the checkpoint of epoch ``newest``, after a correction.

    With ``onward`` it moves all scans that come after its poses. ``None``: no scan moves.

    Raises:
        RefusedError: it does not go back to the first scan that moves, or has none of the source.
        FormatError: a file is damaged.
        OSError: it cannot be read.
    """
    files = history(of_map(segments(store.scans.folder), newest, store.restored))
    is_whole = not files or files[0].after == 0
    poses, first_rows = LogPoses(store.scans.apart_m), list[int]()
    for segment in files:
        first_rows.append(len(poses.poses))
        for entry in read_segment(segment.path):
            poses.take(entry)
    correction, start = _correction(wanted, poses, onward=onward, is_whole=is_whole)
    before = poses.correct(correction)
    if not before:
        return None
    first = files[bisect_right(first_rows, min(before)) - 1]
    base = _base(first, files, store)
    number = 0 if base is None else bisect_right(files, base.epoch, key=lambda one: one.epoch)
    return CorrectedLog(
        replace(correction, first_epoch=first.epoch),
        *(start, base, files[number:], first_rows[number], poses, before),
    )


def kept_scans(store: Store) -> KeptScans | None:
    """Return what is kept of scans, and since when all can be corrected; ``None``: none are kept.

    Raises:
        FormatError: a file is damaged.
        OSError: it cannot be read.
    """
    if not store.scans.is_kept:
        return None
    found = segments(store.scans.folder)
    files = history(of_map(found, store.epoch, store.restored))
    if files and files[0].after > 0:
        base = min(_bases(files, store), default=None)
        files = [] if base is None else [one for one in files if one.epoch > base.epoch]
    entries = chain.from_iterable(read_segment(one.path) for one in files)
    scans = (one for one in entries if isinstance(one, LoggedScan | Transform))
    first = next(scans, None)
    return KeptScans(
        bytes=sum(one.path.stat().st_size for one in found),
        max_bytes=store.scans.max_bytes,
        since_ns=None if first is None else first.stamp_ns,
    )


def _correction(
    wanted: WantedPoses, poses: LogPoses, *, onward: bool, is_whole: bool
) -> tuple[LoggedCorrection, int]:
    """Return the correction that brings a source to some poses, and which of its times it is about.

    Raises:
        RefusedError: none of the poses lies amid the scans that are kept, or, where the log
            ``is_whole`` no more, not all of them.
    """
    source, stamps_ns = wanted.source, wanted.stamps_ns
    if source not in poses.sources:
        known = ", ".join(poses.sources) or "none"
        text = f"no scan of source '{source}' is kept: those of {known} are"
        text += "" if is_whole else ", and the oldest no more (store.log_max_bytes)"
        raise RefusedError("bad_request", text)
    from_ns, to_ns = stamps_ns[[0, -1]].tolist()
    motion, since = poses.motion(source, from_ns, to_ns)
    start = poses.starts(source) - 1 - since
    first_ns, last_ns = motion.stamps_ns[[0, -1]].tolist()
    known_ns, moves = motion.moves(stamps_ns, wanted.world_from_sensor)
    if not len(moves):
        raise RefusedError(
            "bad_request",
            f"none of the times, {from_ns / 1e9:.3f} to {to_ns / 1e9:.3f} s, lies amid the scans "
            f"of '{source}', {first_ns / 1e9:.3f} to {last_ns / 1e9:.3f} s: give the stamps with "
            "which they were published",
        )
    if from_ns < first_ns and start == 0 and not is_whole:
        raise RefusedError(
            "store",
            f"scans of '{source}' before {first_ns / 1e9:.3f} s are not kept any more "
            "(store.log_max_bytes): give poses from then on, if those before are right",
        )
    until_ns = last_ns if onward else to_ns
    return LoggedCorrection(source, known_ns, moves, until_ns, since), start


def _base(first: Segment, files: list[Segment], store: Store) -> CheckpointFile | None:
    """Return the newest checkpoint from which scans of ``first``, one of the files, can be moved.

    Raises:
        RefusedError: there is none, and the files do not go back to an empty map.
    """
    bases = [one for one in _bases(files, store) if one.epoch < first.epoch]
    if not bases and files[0].after > 0:
        raise RefusedError(
            "store",
            f"scans before epoch {files[0].after} are not kept any more (store.log_max_bytes), and "
            "no checkpoint of before the first scan that moves is left (store.keep): the map "
            "cannot be made again without losing what only they have shown",
        )
    return max(bases, default=None)


def _bases(files: list[Segment], store: Store) -> list[CheckpointFile]:
    """Return the checkpoints from which the map can go on with files of the log.

    They have no scan where it was before a correction that came later.
    """
    least = 0 if store.restored is None else store.restored.as_epoch
    return [
        one
        for one in checkpoint_files(store.folder)
        if one.epoch >= max(least, files[0].after)
        and not any(one.epoch in epochs for epochs in store.scans.outdated)
    ]
