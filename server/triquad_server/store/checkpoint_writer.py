"""Writes checkpoints from time to time, on request, before each reset, and at the end."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from triquad_format.errors import FormatError, RefusedError
from triquad_format.scan_log.segment import SegmentWriter
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    ResetReply,
    ResetRequest,
)
from triquad_format.wire.metrics_messages import CheckpointMetrics
from triquad_format.wire.status_messages import KeptScans

from triquad_server.errors import (
    NO_MEMORY,
    LastCheckpointError,
    MapperStoppedError,
    StoreError,
)
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper, MapSnapshot
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.settings import StoreSettings
from triquad_server.store.corrected_log import kept_scans
from triquad_server.store.scrub import Scrubber
from triquad_server.store.store import Store

_log = logging.getLogger(__name__)

_LATE_PERIODS = 2.0  # after so many, what is mapped should be on the disk

_NO_STORE = "the server was started without a store: the map is not kept"


def way_back(kept: int) -> str:
    """Return how to go back to the map before, which is kept as epoch ``kept``."""
    return (
        f"epoch {kept}, the map before, is kept; to go back to it, stop the server and start "
        f"it with --restore {kept}"
    )


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
        if self._period_s > 0:
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

    def reset(self, request: ResetRequest, trails: SourceTrails) -> ResetReply:
        """Forget what lies in the request's box, and reply once an epoch shows it.

        The map as it was stays on disk, so that nothing is lost by mistake. Where sources have been
        in the box is removed from ``trails``.

        Raises:
            RefusedError: the map as it is could not be kept, and was not reset.
        """

        def forget(mapper: Mapper) -> int:
            mapper.reset(request.minimum, request.maximum)
            if self.store is not None:
                corners = request.minimum + mapper.origin, request.maximum + mapper.origin
                self.store.scans.add_reset(*corners)
            trails.forget(request.minimum, request.maximum)
            return mapper.publish().number

        emptied = self._mapper.call(lambda mapper: None if mapper.regions else forget(mapper))
        if emptied is not None:
            return ResetReply(emptied, undo="the map was empty before")
        kept, undo = self._keep()
        epoch = self._mapper.call(forget)
        _log.warning("the map was reset as of epoch %d: %s", epoch, undo)
        return ResetReply(epoch, kept, undo)

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
        with self.writing:
            try:
                return self._write(self.store, undoes, at_cut)
            except Exception as error:
                self._metrics = replace(self._metrics, failed=self._metrics.failed + 1)
                if isinstance(error, StoreError):
                    self.error = str(error)
                    _log.error("%s", self.error)
                raise

    def keep_newest(self, undoes: str) -> CheckpointInfo:
        """Let the newest checkpoint stay as one that ``undoes`` something; write it if it is lost.

        Raises:
            StoreError: it cannot be written, or there is no store.
        """
        with self.writing:
            kept = None if self.store is None else self.store.keep_newest(undoes)
            return kept or self.write(undoes)

    def _keep(self) -> tuple[int | None, str]:
        """Write the map to a checkpoint that stays; return its epoch, and how to go back to it.

        Raises:
            RefusedError: it cannot be written.
        """
        if self.store is None or self.store.keep_resets == 0:
            why = "store.keep_resets = 0" if self.store else "the server has no store"
            return None, f"the map before was not kept: {why}"
        try:
            kept = self.write("a reset").epoch
        except StoreError as error:
            raise RefusedError(
                "store", f"nothing was reset, for the map as it is could not be kept: {error}"
            ) from error
        return kept, way_back(kept)

    def _write(self, store: Store, undoes: str, at_cut: Callable[[], None]) -> CheckpointInfo:
        """Do as :meth:`write`; an error is not recorded yet."""
        base, last = store.base_epoch, self.last

        def cut(mapper: Mapper) -> tuple[MapSnapshot, SegmentWriter | None]:
            at_cut()
            return mapper.snapshot_since(base), store.scans.cut()

        try:
            asked_s = time.monotonic()
            snapshot, scans = self._mapper.call(cut)
            store.scans.keep(scans, snapshot.epoch.number)
            # The base is the last checkpoint, as long as its file and parts are there.
            if not undoes and last is not None and last.epoch == snapshot.epoch.number == base:
                self._saved_s = asked_s
                return last
            started = time.monotonic()
            record, regions = snapshot.record(), snapshot.regions
            del snapshot  # the record has all of it, and memory is shortest now
            info = store.write(record, regions, undoes)
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
        due_s = time.monotonic() + self._period_s
        while not self._stopping.wait(max(0.0, due_s - time.monotonic())):
            due_s = time.monotonic() + self._period_s  # from the beginning of one to the next
            self._write_if_changed()

    def _write_if_changed(self) -> None:
        try:
            self.write()
        except (StoreError, MapperStoppedError):
            return  # the status and the log report it
        except Exception:
            self.error = "an internal error of the server; its log has the details"
            _log.exception("a checkpoint met an internal error")

    def _found_damaged(self, name: str) -> None:
        """Write all of the map again, if the newest checkpoint needs the file ``name``."""
        with self.writing:
            if self.store is not None and self.store.forget_base(name):
                _log.warning(
                    "the newest checkpoint needs %s: all of the map is written again", name
                )
                self._write_if_changed()
