"""The scans that a server has kept with the checkpoints of a map."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files, map_folder
from triquad_format.mapfile.index import read_checkpoint
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.scan_log.log_folder import LOG_NAME, Segment, history, of_map, segments
from triquad_format.scan_log.segment import (
    Entry,
    LoggedCorrection,
    LoggedReset,
    LoggedScan,
    read_segment,
)
from triquad_format.scan_log.tracks import LogPoses

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.recording import ScanEntry, Stream
from triquad_tools.sensors.sweep import PosedScan, moved


class PlacedReset(NamedTuple):
    """A reset, and its place among the scans."""

    scans: int  # that the map took in before
    box: LoggedReset


@dataclass(frozen=True)
class ScanLogRecording:
    """The scans that are in a map now, in the order in which it took them in.

    What was reset later is left out of the scans before; poses are as they were corrected last.
    """

    files: Sequence[Segment]  # the oldest first
    entries: Sequence[ScanEntry]
    counts: Sequence[int]  # of scans in each file
    resets: Sequence[PlacedReset]
    poses: Sequence[Doubles]  # of the scans
    streams: Sequence[Stream]
    remarks: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.entries)

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers, which rise.

        Raises:
            ToolError: a file cannot be read; it is named.
        """
        wanted, first = set(indices), 0
        for segment, count in zip(self.files, self.counts, strict=True):
            here = range(first, first + count)
            first += count
            if wanted.isdisjoint(here):
                continue
            scans = (one for one in _read(segment) if isinstance(one, LoggedScan))
            for index, scan in zip(here, scans, strict=True):
                if index in wanted:
                    later = [reset.box for reset in self.resets if reset.scans > index]
                    pose = self.poses[index]
                    yield PosedScan(_outside(scan, pose, later), pose, no_return=scan.no_return)


def find_scan_log(path: Path) -> Path | None:
    """Return the folder of the scans of a store, of a map in it, or of that itself; else None."""
    folders = [path, path / LOG_NAME]
    with suppress(FormatError, OSError):
        folders.append(map_folder(path) / LOG_NAME)
    with suppress(OSError):
        return next((folder for folder in folders if segments(folder)), None)
    return None


def read_scan_log(folder: Path) -> ScanLogRecording:
    """Return the scans of a folder, after all of it was read.

    Raises:
        ToolError: a file cannot be read; it is named.
    """
    files = history(_of_map(folder))
    entries: list[ScanEntry] = []
    counts: list[int] = []
    resets: list[PlacedReset] = []
    poses, rows, corrections = LogPoses(), list[int](), 0
    with progress("looking through the scans", len(files)) as report:
        for number, segment in enumerate(files, start=1):
            before = len(entries)
            for one in _read(segment):
                poses.take(one)
                corrections += isinstance(one, LoggedCorrection)
                if isinstance(one, LoggedReset):
                    resets.append(PlacedReset(len(entries), one))
                elif isinstance(one, LoggedScan):
                    entries.append(ScanEntry(one.stamp_ns, one.source))
                    rows.append(len(poses.poses) - 1)
            counts.append(len(entries) - before)
            report(number, f"{number} of {len(files)} files")
    names = sorted({entry.source for entry in entries})
    streams = [
        Stream(name, "scans of a map", sum(each.source == name for each in entries), "mapped", name)
        for name in names
    ]
    remarks = []
    if files and files[0].after:
        told = f"scans before epoch {files[0].after} are not kept any more: see store.log_max_bytes"
        remarks.append(told)
    if resets:
        remarks.append(f"what was reset, {len(resets)} times, is left out")
    if corrections:
        remarks.append(f"poses are as they were corrected, {corrections} times")
    kept = [poses.poses[row] for row in rows]
    return ScanLogRecording(files, entries, counts, resets, kept, streams, remarks)


def _of_map(folder: Path) -> list[Segment]:
    """Return the files of a log that the newest checkpoint has; all, where it cannot be read."""
    found = segments(folder)
    with suppress(FormatError, OSError, IndexError):
        newest = checkpoint_files(folder.parent)[0]
        checkpoint = read_checkpoint(newest.path)
        restored = None if checkpoint is None else checkpoint.restored
        return of_map(found, newest.epoch, restored)
    return found


def _read(segment: Segment) -> Iterator[Entry]:
    try:
        yield from read_segment(segment.path)
    except (FormatError, OSError) as error:
        raise ToolError(str(error)) from error


def _outside(scan: LoggedScan, pose: Doubles, resets: Sequence[LoggedReset]) -> Floats:
    """Return the points [N, 3] of a scan that lie in none of the boxes."""
    if not resets:
        return scan.points
    at = moved(scan.points, pose)
    kept = np.ones(len(at), np.bool_)
    for box in resets:
        kept &= ~((at >= box.minimum) & (at <= box.maximum)).all(axis=1)
    return scan.points[kept]
