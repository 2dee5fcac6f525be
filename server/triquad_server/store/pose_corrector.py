"""Makes the map again from the scans that were kept, where better poses of them come."""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import chain

import numpy as np
from triquad_format.errors import FormatError, RefusedError
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import pose_matrices
from triquad_format.scan_log.segment import Entry, LoggedReset, LoggedScan
from triquad_format.wire.limits import MAX_KEYFRAMES
from triquad_format.wire.source_messages import CorrectPosesReply, CorrectPosesRequest

from triquad_server.errors import ScanRefusedError, StoreError
from triquad_server.intake.pose_check import PoseCheck
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.store.checkpoint_writer import CheckpointWriter, way_back
from triquad_server.store.corrected_log import CorrectedLog, WantedPoses, corrected_log
from triquad_server.store.restore import valid_checkpoint
from triquad_server.store.store import Store

_log = logging.getLogger(__name__)

_LAST_SCANS = 2  # that came meanwhile

_UNIT_TOLERANCE = 1e-3  # of the length of a quaternion

_OFTEN = {"map_full", "no_memory", "too_many_regions"}  # reasons for which all else is refused, too


class PoseCorrector:
    """Corrects the poses of kept scans. While the map is made again, it goes on as it was."""

    def __init__(
        self,
        mapper: MapperThread,
        checkpoints: CheckpointWriter,
        trails: SourceTrails,
        max_bytes: int,
        is_stopping: Callable[[], bool],
    ) -> None:
        """Correct the map of ``mapper``, with its store, and the ``trails`` of its sources.

        ``max_bytes`` are what maps may take together. Once ``is_stopping``, nothing is corrected.
        """
        self._mapper = mapper
        self._max_bytes = max_bytes
        self._is_stopping = is_stopping
        self._checkpoints = checkpoints
        self._trails = trails

    def answer(self, request: CorrectPosesRequest) -> CorrectPosesReply:
        """Make the map as the corrected poses would have made it, and reply once it is there.

        Raises:
            RefusedError: ``bad_request``, also where the poses seem to be meant otherwise;
                ``store`` where what is needed for it is not kept; ``busy`` where there is no room
                for a second map. The map stays as it is.
        """
        store = self._checkpoints.store
        if store is None or not store.scans.is_kept:
            raise RefusedError(
                "store",
                "poses are corrected by making the map again from its scans, and they are not "
                "kept: start the server with --store, and store.log_max_bytes above 0",
            )
        used = self._mapper.progress.map.map_bytes
        if 2 * used > self._max_bytes:
            raise RefusedError(
                "busy",
                f"it takes a second map of {used / 1e6:.0f} MB for a while, and memory.max_bytes = "
                f"{self._max_bytes} has no room for that: start the server with more",
            )
        wanted = _wanted(request, self._mapper.call(lambda mapper: mapper.origin))
        followed = deque[Entry]()
        try:
            # So that the log has all until there.
            newest = self._checkpoints.write(at_cut=lambda: store.scans.follow(followed)).epoch
            with self._checkpoints.writing:  # which deletes checkpoints, too
                log = corrected_log(store, newest, wanted, onward=request.onward)
                if log is None:
                    return CorrectPosesReply(newest, scans_moved=0, scans_learnt=0)
                self._checkpoints.correcting = log.moved
                kept = self._checkpoints.keep_newest("correcting poses").epoch
                again = _MapAgain(self._mapper.call(lambda mapper: mapper), log)
            # The cores are for the other map: what this one learnt meanwhile would be lost.
            with self._mapper.without_training():
                return self._correct(store, log, again, followed, kept)
        except (StoreError, FormatError, OSError) as error:
            raise RefusedError("store", f"no pose was corrected: {error}") from error
        finally:
            store.scans.follow(None)
            self._checkpoints.correcting = 0

    def _correct(
        self,
        store: Store,
        log: CorrectedLog,
        again: "_MapAgain",
        followed: "deque[Entry]",
        kept: int,
    ) -> CorrectPosesReply:
        """Make the map again, and have it in place of the one before."""
        began_s = time.monotonic()
        source = log.correction.source
        _log.info("%d scans of %s have better poses: the map is made again", log.moved, source)
        for entry in chain(log.entries(), map(log.late, _until_few_are_left(followed))):
            if self._is_stopping():
                raise RefusedError("busy", "the server is stopping: no pose was corrected")
            again.take(entry)
        if (told := again.check.misreading()) is not None:
            raise RefusedError("bad_request", f"no pose was corrected: {told}")

        def change(mapper: Mapper) -> int:
            while followed:
                again.take(log.late(followed.popleft()))
            mapper.become(again.map)
            store.scans.add_correction(log.logged())
            poses = log.poses.of(source)
            poses[:, :3, 3] -= mapper.origin
            self._trails.retrace(source, poses)
            return mapper.publish().number

        epoch = self._mapper.call(change)
        with suppress(StoreError):  # which the log and the status tell
            self._checkpoints.write()  # else a server that is killed would have the map of before
        took_s, undo = time.monotonic() - began_s, way_back(kept)
        _log.warning(
            "%d scans of %s were corrected as of epoch %d, after %.1f s: %s",
            *(log.moved, source, epoch, took_s, undo),
        )
        if store.keep_resets == 0:
            return CorrectPosesReply(epoch, log.moved, again.scans)
        return CorrectPosesReply(epoch, log.moved, again.scans, kept, undo)


class _MapAgain:
    """A map that is made again."""

    def __init__(self, live: Mapper, log: CorrectedLog) -> None:
        base = log.base
        self.map = live.other(None if base is None else valid_checkpoint(base).record)
        self.scans = 0  # that were taken in
        self.check = PoseCheck()  # of those that the correction is about
        self._correction = log.correction

    def take(self, entry: Entry) -> None:
        """Take in a scan, or forget what was reset.

        Raises:
            RefusedError: the map has no room for it.
        """
        if isinstance(entry, LoggedReset):
            origin = self.map.origin
            self.map.reset(entry.minimum - origin, entry.maximum - origin)
        elif isinstance(entry, LoggedScan):
            try:
                self._take_scan(entry)
            except ScanRefusedError as error:
                if error.reason in _OFTEN:
                    raise RefusedError("busy", f"no pose was corrected: {error}") from error
                _log.warning("a kept scan of %s is left out: %s", entry.source, error)

    def _take_scan(self, scan: LoggedScan) -> None:
        rays = self.map.ingest(
            scan.points,
            scan.world_from_sensor,
            scan.stamp_ns // 1_000_000_000,
            source=scan.source,
            no_return=scan.no_return,
        )
        self.scans += 1
        about = self._correction
        if scan.source == about.source and about.stamps_ns[0] <= scan.stamp_ns <= about.until_ns:
            self.check.see(rays, scan.world_from_sensor[:3, :3])


def _until_few_are_left(followed: "deque[Entry]") -> Iterator[Entry]:
    """Yield what came meanwhile; the last few are taken in while mapping waits."""
    while len(followed) > _LAST_SCANS:
        yield followed.popleft()


def _wanted(request: CorrectPosesRequest, origin: Doubles) -> WantedPoses:
    """Return the poses that a request wants, in the coordinates of the map's user.

    Raises:
        RefusedError: it is none.
    """
    stamps_ns, turns = request.stamps_ns, request.quaternions
    counts = {len(stamps_ns), len(request.positions), len(turns)}
    if len(counts) > 1 or not 0 < len(stamps_ns) <= MAX_KEYFRAMES:
        raise RefusedError(
            "bad_request",
            f"{len(stamps_ns)} times, {len(request.positions)} positions and {len(turns)} "
            f"quaternions: as many of each, 1 to {MAX_KEYFRAMES}, make a correction",
        )
    if (np.diff(stamps_ns) <= 0).any():
        raise RefusedError("bad_request", "the times do not rise")
    lengths = np.linalg.norm(turns, axis=1, keepdims=True)
    if (abs(lengths - 1) > _UNIT_TOLERANCE).any():
        raise RefusedError("bad_request", "a quaternion has not the length 1")
    poses = pose_matrices(request.positions + origin, turns / lengths)
    return WantedPoses(request.source, stamps_ns, poses)
