"""The scans that were kept, with corrected poses, from the first one that moves."""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, replace
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
from triquad_format.scan_log.tracks import LogPoses, corrected, motions, source_of

from triquad_server.store.store import Store

_TOLERANCE, _AT = 0.02, 40.0
"""A scan has moved if anything within 100 voxels of its sensor has, by a twentieth of a voxel: in
units of how far kept scans are apart."""


class WantedPoses(NamedTuple):
    """Better poses of a source, in the coordinates of who gave them."""

    source: str
    stamps_ns: Longs  # [K] rising, nanoseconds since 1970
    world_from_sensor: Doubles  # [K, 4, 4]


@dataclass(frozen=True)
class CorrectedLog:
    """What a map is to be made of again."""

    correction: LoggedCorrection
    start: int  # of the source's times, from 0 on: whose scans move
    base: CheckpointFile | None  # from which it goes on; None: it begins with nothing
    files: list[Segment]  # of the log, with all that came after that
    first_row: int  # with which these begin
    poses: LogPoses
    moved: int  # the number of scans that move

    def entries(self) -> Iterator[LoggedScan | LoggedReset]:
        """Yield kept scans, with corrected poses, and resets, in their order.

        Raises:
            FormatError: a file is damaged.
            OSError: it cannot be read.
        """
        row = self.first_row
        for segment in self.files:
            for entry in read_segment(segment.path):
                if isinstance(entry, LoggedScan):
                    yield replace(entry, world_from_sensor=self.poses.poses[row])
                elif isinstance(entry, LoggedReset):
                    yield entry
                row += isinstance(entry, LoggedScan | Transform)

    def late(self, entry: Entry) -> Entry:
        """Return what came meanwhile as the log will have it: before the correction, so it moves.

        The poses have it, too, from then on.
        """
        source = self.correction.source
        self.poses.take(entry)
        if isinstance(entry, LoggedReset | LoggedCorrection):
            return entry
        poses = self.poses.poses
        if source_of(entry) == source and self.poses.starts(source) - 1 == self.start:
            stamps_ns = np.array([entry.stamp_ns])
            poses[-1] = corrected(self.correction, stamps_ns, poses[-1][None])[0]
        if isinstance(entry, LoggedScan):
            return replace(entry, world_from_sensor=poses[-1])
        return entry

    def logged(self) -> LoggedCorrection:
        """Return the correction as it stands in the log after what came meanwhile."""
        since = self.poses.starts(self.correction.source) - 1 - self.start
        return replace(self.correction, since=since)


class _Earlier(NamedTuple):
    """A correction that stands in the log."""

    file: int
    first_moved: int  # the file with the first scan that it moved; -1: it is not kept any more


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
    apart_m = store.scans.apart_m
    is_whole = not files or files[0].after == 0
    poses, first_rows, earlier = LogPoses(), list[int](), list[_Earlier]()
    for number, segment in enumerate(files):
        first_rows.append(len(poses.poses))
        for entry in read_segment(segment.path):
            if isinstance(entry, LoggedCorrection):
                rows = _moved(poses.correct(entry), apart_m)
                if not is_whole and poses.begin_amid(entry):
                    earlier.append(_Earlier(number, -1))
                elif len(rows):
                    earlier.append(_Earlier(number, _file(first_rows, rows.min())))
            else:
                poses.take(entry)
    correction, start = _correction(wanted, poses, onward=onward, is_whole=is_whole)
    rows = _moved(poses.correct(correction), apart_m)
    if not len(rows):
        return None
    number, base = _base(_file(first_rows, rows.min()), files, earlier, store)
    return CorrectedLog(
        correction, start, base, files[number:], first_rows[number], poses, len(rows)
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


def _base(
    first: int, files: list[Segment], earlier: list[_Earlier], store: Store
) -> tuple[int, CheckpointFile | None]:
    """Return the newest checkpoint that has nothing of file ``first``, and the file after it.

    Nor may it have scans where they were before a correction that came after it.
    """
    least = 0 if store.restored is None else store.restored.as_epoch
    checkpoints = [one for one in checkpoint_files(store.folder) if one.epoch >= least]
    for number in range(first, -1, -1):
        if any(one.first_moved < number <= one.file for one in earlier):
            continue
        since, until = files[number].after, files[number].epoch
        bases = [one for one in checkpoints if since <= one.epoch < until]
        if bases:
            base = max(bases, key=lambda one: one.epoch)
            return number, base
    if files[0].after == 0:
        return 0, None
    raise RefusedError(
        "store",
        f"scans before epoch {files[0].after} are not kept any more (store.log_max_bytes), and no "
        "checkpoint of before the first scan that moves is left (store.keep): the map cannot be "
        "made again without losing what only they have shown",
    )


def _file(first_rows: list[int], row: int) -> int:
    """Return the number of the file that has a row."""
    return bisect_right(first_rows, row) - 1


def _moved(corrected: tuple[Longs, Doubles, Doubles], apart_m: float) -> Longs:
    """Return the rows [M] of those poses [N, 4, 4] that differ by more than the tolerance."""
    rows, before, after = corrected
    moved: Longs = rows[motions(before, after, _AT * apart_m) > _TOLERANCE * apart_m]
    return moved
