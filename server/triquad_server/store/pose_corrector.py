"""Makes regions of the map again from scans that were kept, where better poses of them come."""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import chain

import numpy as np
from triquad_format.errors import FormatError, RefusedError
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.pose import pose_matrices
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import Entry, LoggedReset, LoggedScan
from triquad_format.wire.limits import MAX_KEYFRAMES
from triquad_format.wire.source_messages import CorrectPosesReply, CorrectPosesRequest

from triquad_server.errors import ScanRefusedError, StoreError
from triquad_server.intake.pose_check import PoseCheck
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.store.checkpoint_writer import CheckpointWriter
from triquad_server.store.corrected_log import CorrectedLog, WantedPoses, corrected_log
from triquad_server.store.resets import way_back
from triquad_server.store.restore import regions_of
from triquad_server.store.scan_reach import ScanReach
from triquad_server.store.store import Store

_log = logging.getLogger(__name__)

_LAST_SCANS = 2  # that came meanwhile

_UNIT_TOLERANCE = 1e-3  # of the length of a quaternion

_MOST_BEGUN = 3  # times that a correction begins, where scans that move come meanwhile

_OFTEN = {"map_full", "no_memory", "too_many_regions"}  # reasons for which all else is refused, too


class PoseCorrector:
    """Corrects the poses of kept scans. While regions are made again, the map goes on as it was."""

    def __init__(
        self,
        mapper: MapperThread,
        checkpoints: CheckpointWriter,
        trails: SourceTrails,
        is_stopping: Callable[[], bool],
    ) -> None:
        """Correct the map of ``mapper``, with its store, and the ``trails`` of its sources.

        Once ``is_stopping``, nothing is corrected.
        """
        self._mapper = mapper
        self._is_stopping = is_stopping
        self._checkpoints = checkpoints
        self._trails = trails

    def answer(self, request: CorrectPosesRequest) -> CorrectPosesReply:
        """Make the map as the corrected poses would have made it, and reply once it is there.

        Raises:
            RefusedError: ``bad_request``, also where the poses seem to be meant otherwise;
                ``store`` where what is needed for it is not kept; ``busy`` where there is no room
                for regions that are made again. The map stays as it is.
        """
        store = self._checkpoints.store
        if store is None or not store.scans.is_kept:
            raise RefusedError(
                "store",
                "poses are corrected by making the map again from its scans, and they are not "
                "kept: start the server with --store, and store.log_max_bytes above 0",
            )
        live = self._mapper.call(lambda mapper: mapper)
        wanted = _wanted(request, live.origin)
        followed = deque[Entry]()
        try:
            # So that the log has all until there.
            newest = self._checkpoints.write(at_cut=lambda: store.scans.follow(followed)).epoch
            with self._checkpoints.writing:  # which deletes checkpoints, too
                log = corrected_log(store, newest, wanted, onward=request.onward)
                if log is None:
                    return CorrectPosesReply(newest, scans_moved=0, scans_learnt=0)
                self._checkpoints.correcting = len(log.before)
                again = _MapAgain(live, log, self._is_stopping)
                self._check_room(again)
                again.begin()
                kept = self._checkpoints.keep_newest("correcting poses").epoch
            # The cores are for the regions that are made again.
            with self._mapper.without_training():
                return self._correct(store, log, again, followed, kept)
        except (StoreError, FormatError, OSError) as error:
            raise RefusedError("store", f"no pose was corrected: {error}") from error
        finally:
            store.scans.follow(None)
            self._checkpoints.correcting = 0

    def _check_room(self, again: "_MapAgain") -> None:
        """Raise :class:`RefusedError` where there is no room for regions that are made again."""

        def check(mapper: Mapper) -> None:
            needed = mapper.regions.all.bytes_of(again.touched)
            if not mapper.regions.room.has(needed):
                raise RefusedError(
                    "busy",
                    f"it takes another {needed / 1e6:.0f} MB for a while, and there is no room for "
                    f"that ({mapper.memory}): start the server with more",
                )

        self._mapper.call(check)

    def _correct(
        self,
        store: Store,
        log: CorrectedLog,
        again: "_MapAgain",
        followed: "deque[Entry]",
        kept: int,
    ) -> CorrectPosesReply:
        """Make regions again, and have them in place of those before."""
        began_s = time.monotonic()
        moved, source = len(log.before), log.correction.source
        _log.info("%d scans of %s have better poses: regions are made again", moved, source)

        def change(mapper: Mapper) -> int | None:
            while followed:
                again.take_late(followed.popleft())
            if not again.has_all:
                return None
            mapper.become(again.map)
            store.scans.add_correction(log.logged())
            poses = log.poses.of(source)
            poses[:, :3, 3] -= mapper.origin
            self._trails.retrace(source, poses)
            return mapper.publish().number

        self._make(again, followed)
        while (epoch := self._mapper.call(change)) is None:
            self._check_room(again)
            with self._checkpoints.writing:  # which deletes checkpoints, too
                again.begin()
            self._make(again, followed)
        with suppress(StoreError):  # which the log and the status tell
            self._checkpoints.write()  # else a server that is killed would have the map of before
        took_s, undo = time.monotonic() - began_s, way_back(kept)
        _log.warning(
            "%d scans of %s were corrected as of epoch %d, after %.1f s: %s",
            *(moved, source, epoch, took_s, undo),
        )
        if store.keep_resets == 0:
            return CorrectPosesReply(epoch, moved, again.scans)
        return CorrectPosesReply(epoch, moved, again.scans, kept, undo)

    def _make(self, again: "_MapAgain", followed: "deque[Entry]") -> None:
        """Take in all but the last few scans, for which mapping waits."""
        late = map(again.take_late, _until_few_are_left(followed))
        for _ in chain(map(again.take, again.log.entries()), late):
            again.check_goes_on()
        if (told := again.check.misreading()) is not None:
            raise RefusedError("bad_request", f"no pose was corrected: {told}")


class _MapAgain:
    """The regions that scans which move reach, made again."""

    def __init__(self, live: Mapper, log: CorrectedLog, is_stopping: Callable[[], bool]) -> None:
        self.log = log
        self._is_stopping = is_stopping
        self._begun = 0  # times
        self._live = live
        self._reach = ScanReach(live)
        self.touched = frozenset[RegionIndex]()
        for scan in log.moves():
            self.check_goes_on()
            self.touched |= self._reach.of(scan)

    def check_goes_on(self) -> None:
        """Raise :class:`RefusedError` once the server is stopping."""
        if self._is_stopping():
            raise RefusedError("busy", "the server is stopping: no pose was corrected")

    def begin(self) -> None:
        """Begin, or begin again, with what the base of the log has of the regions.

        Raises:
            RefusedError: scans that move went on to reach other regions.
        """
        self._begun += 1
        if self._begun > _MOST_BEGUN:
            raise RefusedError("busy", "scans that move went on to come: correct the poses again")
        base = self.log.base
        self._regions = self.touched
        record = None if base is None else regions_of(base, self._regions)
        self.map = self._live.other(record, self._regions)
        self.scans = 0  # that were taken in
        self.check = PoseCheck()  # of those that the correction is about

    @property
    def has_all(self) -> bool:
        """Whether no scan that moves, and came meanwhile, reaches other regions."""
        return self.touched == self._regions

    def take_late(self, entry: Entry) -> None:
        """Take in what came meanwhile; errors are those of :meth:`take`."""
        moved = self.log.late(entry)
        if moved is not entry:
            scans = (one for one in (entry, moved) if isinstance(one, LoggedScan | Transform))
            self.touched = self.touched.union(*map(self._reach.of, scans))
        self.take(moved)

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
        if self._regions.isdisjoint(self._reach.of(scan)):
            return
        rays = self.map.ingest(
            scan.points,
            scan.world_from_sensor,
            scan.stamp_ns // 1_000_000_000,
            source=scan.source,
            no_return=scan.no_return,
        )
        self.scans += 1
        about = self.log.correction
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
