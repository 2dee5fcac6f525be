"""Writes checkpoints from time to time, on request, before each reset, and at the end."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

from triquad_format.errors import FormatError, RefusedError
from triquad_format.scan_log.segment import SegmentWriter
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
)
from triquad_format.wire.metrics_messages import CheckpointMetrics
from triquad_format.wire.status_messages import KeptScans

from triquad_server.errors import (
    NO_MEMORY,
    LastCheckpointError,
    MapperStoppedError,
    StoreError,
)
from triquad_server.mapping.map_snapshot import MapSnapshot
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.settings import StoreSettings
from triquad_server.store.corrected_log import kept_scans
from triquad_server.store.scrub import Scrubber
from triquad_server.store.store import Store

_log = logging.getLogger(__name__)

_LOOK_S = 0.5  # after which it is looked again whether regions wait to leave memory

_LATE_PERIODS = 2.0  # after so many, what is mapped should be on the disk

_NO_STORE = "the server was started without a store: the map is not kept"


class CheckpointWriter:
    """Writes the map to its store, from time to time on a thread of its own.

    A store that fails never stops the mapping. The thread has the priority of queries, not that of
    mapping: while other programs are busy, checkpoints would come ever later.
    """

    def __init__(
        self,
        mapper: MapperThread,
        store: Store | None,
        settings: StoreSettings,
    ) -> None:
        """Make the writer; ``settings`` say how often the store is written, and checked."""
        self._mapper = mapper
        self.store = store
        self._period_s = settings.period_s
        self._scrub_h = settings.scrub_h
        self._scrubber: Scrubber | None = None
        self._stopping = threading.Event()
        self._metrics = CheckpointMetrics(0, 0, None, None)
        self._saved_s = time.monotonic()  # when the map was as the newest checkpoint has it
        self._ended_s: float | None = None  # when the last was written, monotonic
        self._timer = threading.Thread(target=self._write_regularly, name="checkpoints")
        self.writing = threading.RLock()  # locked while anything is written, or deleted
        self.error = None if store else _NO_STORE
        self.kept_scans: KeptScans | None = None  # as of the newest checkpoint
        self.correcting = 0  # scans whose poses are being corrected

    @property
    def last(self) -> CheckpointInfo | None:
        """The newest checkpoint; it may be the one that the map was restored from."""
        return None if self.store is None else self.store.last

    def start(self) -> None:
        """Begin to write checkpoints, while the map changes and on request, and to check them."""
        if self.store is None:
            return
        self._survey_scans(self.store)
        self._mapper.stored(self.store.regions.known)
        self._timer.start()
        if self._scrub_h > 0:
            self._scrubber = Scrubber(self.store.folder, self._scrub_h, self._found_damaged)

    def metrics(self) -> CheckpointMetrics:
        """Return how many checkpoints were written, and how long the last took."""
        age_s = None if self._ended_s is None else time.monotonic() - self._ended_s
        return replace(self._metrics, age_s=age_s, late_s=self.late_s)

    @property
    def late_s(self) -> float:
        """Return for how long more is unsaved than there may be; 0: no longer than two periods."""
        if self.store is None or self._period_s == 0:
            return 0.0
        return max(0.0, time.monotonic() - self._saved_s - _LATE_PERIODS * self._period_s)

    @property
    def warning(self) -> str | None:
        """Return that checkpoints are late, and what helps, or why scans are not kept."""
        late_s = self.late_s
        if late_s == 0:
            return None if self.store is None else self.store.scans.error
        unsaved_s = late_s + _LATE_PERIODS * self._period_s
        return (
            f"checkpoints are late: what was mapped in the last {unsaved_s:.0f} s is on no disk, "
            f"with store.period_s = {self._period_s:g}; the server needs more of the processor or "
            "a faster disk, or a longer period"
        )

    def close(self) -> None:
        """Write a last checkpoint, if the map changed since the one before.

        Raises:
            LastCheckpointError: it cannot be written.
        """
        if self._scrubber is not None:
            self._scrubber.close()
        self._stopping.set()
        if self._timer.ident is not None:
            self._timer.join()
        if self.store is None:
            return
        try:
            info = self.write()
        except (StoreError, MapperStoppedError) as error:
            since = "the server started" if self.last is None else f"epoch {self.last.epoch}"
            raise LastCheckpointError(
                f"the last checkpoint was not written, and what was mapped since {since} "
                f"is lost: {error}"
            ) from error
        _log.info("the map is in %s, as of epoch %d", info.path, info.epoch)

    def answer(self, _request: CheckpointRequest) -> CheckpointInfo:
        """Write a checkpoint of the map as it is now; return the last one if nothing changed.

        Raises:
            RefusedError: there is no store, or it cannot be written.
        """
        try:
            return self.write()
        except StoreError as error:
            raise RefusedError("store", str(error)) from error

    def write(self, undoes: str = "", at_cut: Callable[[], None] = lambda: None) -> CheckpointInfo:
        """Write what changed since the last checkpoint, and return that one if nothing did.

        A checkpoint that ``undoes`` something is written even if nothing changed. ``at_cut`` is
        called by the mapper's thread where what the checkpoint has ends.

        Raises:
            StoreError: it cannot be written, for lack of memory too, or there is no store.
            MapperStoppedError: mapping has ended.
        """
        if self.store is None:
            raise StoreError(_NO_STORE)
        store = self.store
        with self._told():
            return self._write(store, undoes, at_cut)

    def keep_newest(self, undoes: str) -> CheckpointInfo:
        """Let the newest checkpoint stay as one that ``undoes`` something; write it if it is lost.

        Raises:
            StoreError: it cannot be written, or there is no store.
        """
        with self.writing:
            kept = None if self.store is None else self.store.keep_newest(undoes)
            return kept or self.write(undoes)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Write to the store; who else writes waits, and the status tells of a failure."""
        with self.writing:
            try:
                yield
            except Exception as error:
                self._metrics = replace(self._metrics, failed=self._metrics.failed + 1)
                if isinstance(error, StoreError):
                    self._mapper.stored(None)
                    self.error = str(error)
                    _log.error("%s", self.error)
                raise

    def _let_regions_leave(self) -> None:
        """Write the regions that wait for it to leave memory."""
        store = self.store
        if store is None:
            return
        with self._told():
            try:
                leaving = self._mapper.call(lambda mapper: mapper.snapshot_of_leaving())
                with closing(leaving):
                    changed = leaving.records(self._mapper.taken)
                    store.put(leaving.epoch.record(()), changed, leaving.facts)
            except MemoryError as error:
                raise StoreError(f"no region can leave memory: {NO_MEMORY}") from error
            self._mapper.stored(store.regions.known)

    def _write(self, store: Store, undoes: str, at_cut: Callable[[], None]) -> CheckpointInfo:
        """Do as :meth:`write`; an error is not recorded yet."""
        base, last = store.base_epoch, self.last

        def cut(mapper: Mapper) -> tuple[MapSnapshot, SegmentWriter | None]:
            at_cut()
            return mapper.snapshot_since(base), store.scans.cut()

        try:
            asked_s = time.monotonic()
            snapshot, scans = self._mapper.call(cut)
            with closing(snapshot):
                store.scans.keep(scans, snapshot.epoch.number)
                # The base is the last checkpoint, as long as its file and parts are there.
                if not undoes and last is not None and last.epoch == snapshot.epoch.number == base:
                    self._saved_s = asked_s
                    return last
                started = time.monotonic()
                changed = snapshot.records(self._mapper.taken)
                info = store.write(snapshot.epoch.record(()), changed, snapshot.facts, undoes)
            self._mapper.stored(store.regions.known)
        except MemoryError as error:
            raise StoreError(f"a checkpoint was not written: {NO_MEMORY}") from error
        self._survey_scans(store)
        if (warning := self.warning) is not None:
            _log.warning("%s", warning)
        self.error, self._saved_s, self._ended_s = None, asked_s, time.monotonic()
        self._metrics = replace(
            self._metrics,
            written=self._metrics.written + 1,
            last_duration_s=self._ended_s - started,
        )
        _log.info("checkpoint %s: epoch %d, %d bytes", info.path, info.epoch, info.bytes)
        return info

    def _survey_scans(self, store: Store) -> None:
        """See how far back poses can be corrected, so that no status has to read files for it."""
        try:
            self.kept_scans = kept_scans(store)
        except (FormatError, OSError) as error:
            _log.warning("how far back poses can be corrected is not known: %s", error)

    def _write_regularly(self) -> None:
        self._try(self._tidy)
        period_s = self._period_s or math.inf
        due_s = time.monotonic() + period_s
        while not self._stopping.wait(min(_LOOK_S, max(0.0, due_s - time.monotonic()))):
            if self._mapper.progress.waits_for_store:
                self._try(self._let_regions_leave)
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + period_s  # from the beginning of one to the next
                self._try(self.write)

    def _tidy(self) -> None:
        """Delete what a server that was killed has left."""
        with self.writing:
            if self.store is not None:
                self.store.tidy()

    def _try(self, write: Callable[[], object]) -> None:
        try:
            write()
        except (StoreError, MapperStoppedError):
            return  # the status and the log report it
        except Exception:
            self.error = "an internal error of the server; its log has the details"
            _log.exception("the store met an internal error")

    def _found_damaged(self, name: str) -> None:
        """Write all of the map again, if the newest checkpoint needs the file ``name``."""
        with self.writing:
            if self.store is not None and self.store.forget_base(name):
                _log.warning(
                    "the newest checkpoint needs %s: all of the map is written again", name
                )
                self._try(self.write)
