"""The scans that a server has kept with the checkpoints of a map."""

import io
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mcap.records import Channel, Footer, Message
from mcap.stream_reader import StreamReader
from triquad_format.errors import DamagedMapFileError, FormatError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files, map_folder
from triquad_format.mapfile.files import open_regular
from triquad_format.mapfile.index import read_checkpoint
from triquad_format.records.arrays import Floats
from triquad_format.records.pose import pose_matrices
from triquad_format.scan_log.log_folder import LOG_NAME, Segment, history, of_map, segments
from triquad_format.scan_log.segment import (
    NO_RETURN,
    RESETS,
    SCANS,
    TRANSFORMS,
    LoggedReset,
    LoggedScan,
)

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.recording import ScanEntry, Stream
from triquad_tools.sensors.ros.from_bytes import decode_cdr
from triquad_tools.sensors.ros.type_store import POINT_CLOUD, TF, stamp_ns
from triquad_tools.sensors.sweep import PosedScan, moved


class PlacedReset(NamedTuple):
    """A reset, and its place among the scans."""

    scans: int  # that the map took in before
    box: LoggedReset


@dataclass(frozen=True)
class ScanLogRecording:
    """The scans that are in a map now, in the order in which it took them in.

    What was reset later is left out of the scans before.
    """

    files: Sequence[Segment]  # the oldest first
    entries: Sequence[ScanEntry]
    counts: Sequence[int]  # of scans in each file
    resets: Sequence[PlacedReset]
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
                    points = _outside(scan, later)
                    yield PosedScan(points, scan.world_from_sensor, no_return=scan.no_return)


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
    with progress("looking through the scans", len(files)) as report:
        for number, segment in enumerate(files, start=1):
            before = len(entries)
            for one in _read(segment):
                if isinstance(one, LoggedReset):
                    resets.append(PlacedReset(len(entries), one))
                else:
                    entries.append(ScanEntry(one.stamp_ns, one.source))
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
    return ScanLogRecording(files, entries, counts, resets, streams, remarks)


def _of_map(folder: Path) -> list[Segment]:
    """Return the files of a log that the newest checkpoint has; all, where it cannot be read."""
    found = segments(folder)
    with suppress(FormatError, OSError, IndexError):
        newest = checkpoint_files(folder.parent)[0]
        checkpoint = read_checkpoint(newest.path)
        restored = None if checkpoint is None else checkpoint.restored
        return of_map(found, newest.epoch, restored)
    return found


def _read(segment: Segment) -> Iterator[LoggedScan | LoggedReset]:
    try:
        yield from read_segment(segment.path)
    except (FormatError, OSError) as error:
        raise ToolError(str(error)) from error


def read_segment(path: Path) -> Iterator[LoggedScan | LoggedReset]:
    """Yield what a file of the log has, in the order in which it came.

    Raises:
        DamagedMapFileError: the file is damaged, or is none of the log.
        OSError: it cannot be read.
    """
    with io.BufferedReader(open_regular(path)) as stream:
        try:
            yield from _entries(stream)
        except Exception as error:  # as the library comes upon what it did not expect
            raise DamagedMapFileError(f"{path} is damaged: {error!r}") from error


def _entries(stream: IO[bytes]) -> Iterator[LoggedScan | LoggedReset]:
    topics: dict[int, str] = {}
    transform, no_return = None, np.zeros((0, 3), np.float32)
    is_whole = False
    for record in StreamReader(stream, validate_crcs=True).records:
        is_whole |= isinstance(record, Footer)
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        if not isinstance(record, Message):
            continue
        topic, data = topics[record.channel_id], record.data
        if topic == TRANSFORMS:
            (transform,), no_return = decode_cdr(data, TF).transforms, no_return[:0]
        elif topic == RESETS:
            yield LoggedReset(*np.frombuffer(data, "<f8").reshape(2, 3))
        elif topic.startswith(NO_RETURN):
            no_return = np.frombuffer(data, "<f4").reshape(-1, 3)
        elif topic.startswith(SCANS):
            yield _scan(decode_cdr(data, POINT_CLOUD), transform, no_return)
    if not is_whole:
        raise FormatError("it has no end")


def _scan(cloud: Any, transform: Any, no_return: Floats) -> LoggedScan:
    """Return a scan of its cloud and the transform before it."""
    source, stamp = cloud.header.frame_id, stamp_ns(cloud.header)
    if (transform.child_frame_id, stamp_ns(transform.header)) != (source, stamp):
        raise FormatError(f"a scan of {source} has no pose before it")
    at, turn = transform.transform.translation, transform.transform.rotation
    pose = pose_matrices(np.array([at.x, at.y, at.z]), np.array([turn.x, turn.y, turn.z, turn.w]))
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    return LoggedScan(source, stamp, pose, points, no_return)


def _outside(scan: LoggedScan, resets: Sequence[LoggedReset]) -> Floats:
    """Return the points [N, 3] of a scan that lie in none of the boxes."""
    if not resets:
        return scan.points
    at = moved(scan.points, scan.world_from_sensor)
    kept = np.ones(len(at), np.bool_)
    for box in resets:
        kept &= ~((at >= box.minimum) & (at <= box.maximum)).all(axis=1)
    return scan.points[kept]
