"""When checkpoints are written: now and then, on request, and at the end."""

import logging
import queue
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass, replace

from triquad_format.errors import RefusedError
from triquad_format.wire.messages import CheckpointInfo, CheckpointRequest
from triquad_format.wire.metrics_messages import CheckpointMetrics
from triquad_map.compiled.team import lower_priority

from triquad_server.errors import StoreBaseError, StoreError
from triquad_server.mapping.mapper import MapChanges
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.store.store import Store
from triquad_server.threads import NICENESS

_log = logging.getLogger(__name__)

_NO_STORE = "the server was started without a store: the map is not kept"


@dataclass(frozen=True)
class _Counts:
    """Checkpoints so far."""

    written: int = 0
    failed: int = 0
    duration_s: float | None = None  # of writing the last
    ended_s: float | None = None  # when the last was written, monotonic


class CheckpointThread:
    """Writes the map to its store, on a thread of its own that gives way to those that answer.

    A store that fails never stops the mapping.
    """

    def __init__(
        self,
        mapper: MapperThread,
        store: Store | None,
        period_s: float,
        last: CheckpointInfo | None,
    ) -> None:
        """``last`` is the checkpoint that the map was restored from."""
        self._mapper = mapper
        self._store = store
        self._period_s = period_s
        self._asked: queue.SimpleQueue[Future[CheckpointInfo]] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._wake = threading.Event()
        self.last = last
        self._counts = _Counts()
        self.error = None if store else _NO_STORE
        self._thread = threading.Thread(target=self._run, name="checkpoints")

    @property
    def has_store(self) -> bool:
        """Whether there is anywhere to write checkpoints to."""
        return self._store is not None

    def start(self) -> None:
        """Begin to write checkpoints, while the map changes and on request."""
        if self._store is not None:
            self._thread.start()

    def metrics(self) -> CheckpointMetrics:
        """How many checkpoints were written, and how long the last took."""
        counts = self._counts
        age_s = None if counts.ended_s is None else time.monotonic() - counts.ended_s
        return CheckpointMetrics(counts.written, counts.failed, counts.duration_s, age_s)

    def close(self) -> None:
        """Write a last checkpoint, if the map changed since the one before.

        Raises:
            StoreError: it cannot be written.
        """
        self._stopping.set()
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join()
        if self._store is not None:
            self._write()

    def answer(self, _request: CheckpointRequest) -> CheckpointInfo:
        """A checkpoint of the map as it is now; the last one where nothing changed.

        Raises:
            RefusedError: there is no store, or it cannot be written.
        """
        if self._store is None:
            raise RefusedError("store", _NO_STORE)
        asked: Future[CheckpointInfo] = Future()
        self._asked.put(asked)
        self._wake.set()
        try:
            return asked.result()
        except StoreError as error:
            raise RefusedError("store", str(error)) from error

    def _run(self) -> None:
        lower_priority(2 * NICENESS)  # mapping comes first, too
        due = time.monotonic() + self._period_s
        while not self._stopping.is_set():
            self._wake.wait(due - time.monotonic() if self._period_s > 0 else None)
            self._wake.clear()
            self._write_as_asked()
            if self._period_s > 0 and time.monotonic() >= due:
                self._write_if_changed()
                due = time.monotonic() + self._period_s
            self._fold()

    def _write_as_asked(self) -> None:
        while not self._asked.empty():
            asked = self._asked.get()
            try:
                asked.set_result(self._write())
            except Exception as error:
                asked.set_exception(error)

    def _write_if_changed(self) -> None:
        try:
            self._write()
        except StoreError:
            return  # the status and the log have it
        except Exception:
            self.error = "an internal error of the server; its log has the details"
            _log.exception("a checkpoint met an internal error")

    def _write(self) -> CheckpointInfo:
        assert self._store is not None
        base = self._store.base_epoch
        changes = self._changes_since(base)
        last = self.last
        # The base is the last checkpoint, as long as its files are as they were written.
        if last is not None and last.epoch == changes.record.epoch == base:
            return last
        started = time.monotonic()
        try:
            info = self._write_changes(self._store, changes)
        except Exception as error:
            self._counts = replace(self._counts, failed=self._counts.failed + 1)
            if isinstance(error, StoreError):
                self.error = str(error)
                _log.error("%s", error)
            raise
        self.last, self.error = info, None
        now = time.monotonic()
        self._counts = replace(
            self._counts,
            written=self._counts.written + 1,
            duration_s=now - started,
            ended_s=now,
        )
        _log.info("checkpoint %s: epoch %d, %d bytes", info.path, info.epoch, info.bytes)
        return info

    def _write_changes(self, store: Store, changes: MapChanges) -> CheckpointInfo:
        """Write the changes; all of the map where the checkpoints before were damaged since."""
        try:
            return store.write(changes)
        except StoreBaseError as error:
            _log.warning("%s; all of the map is written instead", error)
            return store.write(self._changes_since(None))

    def _changes_since(self, base: int | None) -> MapChanges:
        """What a checkpoint needs that follows the epoch ``base``.

        Raises:
            StoreError: memory does not suffice for a copy of it.
        """
        try:
            return self._mapper.call(lambda mapper: mapper.changes_since(base))
        except MemoryError as error:
            raise StoreError("the map cannot be copied for a checkpoint: out of memory") from error

    def _fold(self) -> None:
        """Put old checkpoints together, where there are many."""
        assert self._store is not None
        try:
            info = self._store.fold(self._interrupted)
        except StoreBaseError as error:
            _log.warning("%s; all of the map is written instead", error)
            self.last = None
            self._write_if_changed()
            return
        except StoreError as error:
            self.error = str(error)
            _log.error("%s", error)
            return
        except Exception:
            _log.exception("folding checkpoints met an internal error")
            return
        if info is None:
            return
        _log.info("folded %s: epoch %d, %d bytes", info.path, info.epoch, info.bytes)
        if self.last is not None and self.last.epoch == info.epoch:
            self.last = info

    def _interrupted(self) -> bool:
        """Whether something is more urgent than folding, which can be begun again."""
        return self._stopping.is_set() or not self._asked.empty()
