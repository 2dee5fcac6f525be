"""The scans that were kept, with corrected poses, from the first one that moves."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.mapfile.checkpoint_folder import CheckpointFile, checkpoint_files
from triquad_format.records.arrays import Bools, Doubles
from triquad_format.scan_log.log_folder import Segment, history, of_map, segments
from triquad_format.scan_log.reading import Entry, read_segment
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import LoggedCorrection, LoggedReset, LoggedScan
from triquad_format.scan_log.tracks import SourceTrack, SourceTracks

from triquad_server.store.store import Store

_TOLERANCE, _AT = 0.02, 40.0
"""A scan has moved if anything within 100 voxels of its sensor has, by a twentieth of a voxel: in
units of how far kept scans are apart."""


@dataclass(frozen=True)
class CorrectedLog:
    """What a map is to be made of again."""

    correction: LoggedCorrection
    base: CheckpointFile | None  # from which it goes on; None: it begins with nothing
    files: list[Segment]  # of the log, with all that came after that
    tracks: SourceTracks
    moved: int  # the number of kept scans that move

    def entries(self) -> Iterator[LoggedScan | LoggedReset]:
        """Yield kept scans, with corrected poses, and resets, in their order.

        Raises:
            FormatError: a file is damaged.
            OSError: it cannot be read.
        """
        for segment in self.files:
            for entry in read_segment(segment.path):
                if isinstance(entry, LoggedScan):
                    pose = self.tracks[entry.source].pose(entry.stamp_ns)
                    yield replace(entry, world_from_sensor=pose)
                elif isinstance(entry, LoggedReset):
                    yield entry

    def late(self, entry: Entry) -> Entry:
        """Return what came meanwhile as the log will have it: before the correction, so it moves.

        The tracks have it, too, from then on.
        """
        source = self.correction.source
        track = self.tracks[source]
        if isinstance(entry, LoggedScan) and entry.source == source:
            pose = track.add_late(entry.stamp_ns, entry.world_from_sensor)
            return replace(entry, world_from_sensor=pose)
        if isinstance(entry, Transform) and entry.child == source:
            return entry._replace(pose=track.add_late(entry.stamp_ns, entry.pose))
        return entry


class _Kept(NamedTuple):
    """A scan that was kept."""

    file: int  # its number
    stamp_ns: int


class _Earlier(NamedTuple):
    """A correction that stands in the log."""

    file: int
    first_moved: int  # the file with the first scan that it moved


def corrected_log(store: Store, correction: LoggedCorrection, *, onward: bool) -> CorrectedLog:
    """Return the log of a store, up to its newest checkpoint, after a correction.

    With ``onward`` it moves all scans that come after its poses.

    Raises:
        RefusedError: it does not go back to the first scan that moves, or has none of the source.
        FormatError: a file is damaged.
        OSError: it cannot be read.
    """
    files = history(of_map(segments(store.scans.folder), store.epoch, store.restored))
    apart_m = store.scans.apart_m
    tracks, scans = SourceTracks(), defaultdict[str, list[_Kept]](list)
    earlier = list[_Earlier]()
    for number, segment in enumerate(files):
        for entry in read_segment(segment.path):
            if isinstance(entry, LoggedScan):
                scans[entry.source].append(_Kept(number, entry.stamp_ns))
            if isinstance(entry, LoggedCorrection):
                moved = _move(scans[entry.source], tracks[entry.source], entry, apart_m)
                earlier += [_Earlier(number, moved[0].file)] if moved else []
            else:
                tracks.take(entry)
    if correction.source not in tracks:
        raise RefusedError("bad_request", _no_source(correction.source, tracks))
    track = tracks[correction.source]
    _check_times(correction, track)
    correction = _until(int(track.stamps_ns[-1]), correction, onward=onward)
    moved = _move(scans[correction.source], track, correction, apart_m)
    log = CorrectedLog(correction, None, files, tracks, len(moved))
    return _from(moved[0].file, earlier, log, store) if moved else log


def _move(
    scans: list[_Kept], track: SourceTrack, correction: LoggedCorrection, apart_m: float
) -> list[_Kept]:
    """Correct a track; return which of the kept scans moved by more than the tolerance."""
    before = track.poses
    track.correct(correction)
    stamps = set(track.stamps_ns[_moved(before, track.poses, apart_m)].tolist())
    return [scan for scan in scans if scan.stamp_ns in stamps]


def _check_times(correction: LoggedCorrection, track: SourceTrack) -> None:
    """Raise RefusedError where no pose of a correction lies amid the scans that are kept."""
    if not track.covers(correction.stamps_ns).any():
        from_s, to_s = correction.stamps_ns[[0, -1]] / 1e9
        first_s, last_s = track.stamps_ns[[0, -1]] / 1e9
        raise RefusedError(
            "bad_request",
            f"none of the times, {from_s:.3f} to {to_s:.3f} s, lies amid the scans of "
            f"'{correction.source}', {first_s:.3f} to {last_s:.3f} s: give the stamps with which "
            "they were published",
        )


def _until(newest_ns: int, correction: LoggedCorrection, *, onward: bool) -> LoggedCorrection:
    """Return a correction without its poses after the newest scan.

    Scans that come later find it as it is then: those that it is about move as the newest one.
    """
    known = correction.stamps_ns <= newest_ns
    return replace(
        correction,
        stamps_ns=correction.stamps_ns[known],
        world_from_sensor=correction.world_from_sensor[known],
        until_ns=newest_ns if onward else correction.until_ns,
    )


def _from(first: int, earlier: list[_Earlier], log: CorrectedLog, store: Store) -> CorrectedLog:
    """Return the log from the newest checkpoint on that has nothing of file ``first``.

    Nor may it have scans where they were before a correction that came after it.
    """
    files = log.files
    least = 0 if store.restored is None else store.restored.as_epoch
    checkpoints = [one for one in checkpoint_files(store.folder) if one.epoch >= least]
    for number in range(first, -1, -1):
        if any(one.first_moved < number <= one.file for one in earlier):
            continue
        since, until = files[number].after, files[number].epoch
        bases = [one for one in checkpoints if since <= one.epoch < until]
        if bases:
            base = max(bases, key=lambda one: one.epoch)
            return replace(log, base=base, files=files[number:])
    if files[0].after == 0:
        return log
    raise RefusedError(
        "store",
        f"scans before epoch {files[0].after} are not kept any more (store.log_max_bytes), and no "
        "checkpoint of before the first scan that moves is left (store.keep): the map cannot be "
        "made again without losing what only they have shown",
    )


def _moved(before: Doubles, after: Doubles, apart_m: float) -> Bools:
    """Return which poses [N, 4, 4] differ by more than the tolerance."""
    shifts = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    turns = np.linalg.norm(after[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2)
    result: Bools = shifts + _AT * apart_m * turns > _TOLERANCE * apart_m
    return result


def _no_source(name: str, tracks: SourceTracks) -> str:
    known = ", ".join(sorted(tracks)) or "none"
    return f"no scan of source '{name}' is kept: those of {known} are"
