"""Writes checkpoints from time to time, on request, and at the end."""

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from triquad_format.errors import RefusedError
from triquad_format.wire.messages import CheckpointInfo, CheckpointRequest
from triquad_format.wire.metrics_messages import CheckpointMetrics
from triquad_map.compiled.team import lower_priority

from triquad_server.errors import (
    LastCheckpointError,
    MapperStoppedError,
    StoreBaseError,
    StoreError,
)
from triquad_server.mapping.map_snapshot import MapChanges, MapSnapshot
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.process.threads import NICENESS
from triquad_server.store.store import Store

_log = logging.getLogger(__name__)

_NO_STORE = "the server was started without a store: the map is not kept"

ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class _Job:
    """A job to run on the thread, and the future that its caller waits for."""

    run: Callable[[], Any]
    result: Future[Any]


@dataclass(frozen=True)
class _Counts:
    """Counters of checkpoints so far."""

    written: int = 0
    failed: int = 0
    duration_s: float | None = None  # seconds of writing the last
    ended_s: float | None = None  # when the last was written, monotonic


class CheckpointThread:
    """Writes the map to its store, on a thread of its own that gives way to queries.

    A store that fails never stops the mapping.
    """

    def __init__(
        self,
        mapper: MapperThread,
        store: Store | None,
        period_s: float,
        last: CheckpointInfo | None,
    ) -> None:
        """Make the thread; ``last`` is the checkpoint that the map was restored from."""
        self._mapper = mapper
        self._store = store
        self._period_s = period_s
        self._asked: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._wake = threading.Event()
        self.last = last
        self._counts = _Counts()
        self.error = None if store else _NO_STORE
        self._thread = threading.Thread(target=self._run, name="checkpoints")

    @property
    def has_store(self) -> bool:
        """Return whether there is a store to write checkpoints to."""
        return self._store is not None

    def start(self) -> None:
        """Begin to write checkpoints, while the map changes and on request."""
        if self._store is not None:
            self._thread.start()

    def metrics(self) -> CheckpointMetrics:
        """Return how many checkpoints were written, and how long the last took."""
        counts = self._counts
        age_s = None if counts.ended_s is None else time.monotonic() - counts.ended_s
        return CheckpointMetrics(counts.written, counts.failed, counts.duration_s, age_s)

    def close(self) -> None:
        """Write a last checkpoint, if the map changed since the one before.

        Raises:
            LastCheckpointError: it cannot be written.
        """
        self._stopping.set()
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join()
        if self._store is None:
            return
        try:
            info = self.write()
        except (StoreError, MapperStoppedError) as error:
            raise LastCheckpointError(
                f"the last checkpoint was not written, and what was mapped since {self._kept()} "
                f"is lost: {error}"
            ) from error
        _log.info("the map is in %s, as of epoch %d", info.path, info.epoch)

    def answer(self, _request: CheckpointRequest) -> CheckpointInfo:
        """Write a checkpoint of the map as it is now; return the last one if nothing changed.

        Raises:
            RefusedError: there is no store, or it cannot be written.
        """
        try:
            return self.call(self.write)
        except StoreError as error:
            raise RefusedError("store", str(error)) from error

    def call(self, job: Callable[[], ResultT]) -> ResultT:
        """Run ``job`` on this thread and return its result: nothing else is written meanwhile.

        Raises:
            StoreError: there is no store.
        """
        if self._store is None:
            raise StoreError(_NO_STORE)
        result: Future[ResultT] = Future()
        self._asked.put(_Job(job, result))
        self._wake.set()
        return result.result()

    def found_damaged(self, name: str) -> None:
        """Have all of the map written again, if the newest checkpoint needs the file ``name``."""
        self._asked.put(_Job(lambda: self._write_anew(name), Future()))
        self._wake.set()

    def _write_anew(self, name: str) -> None:
        assert self._store is not None
        if self._store.forget_base(name):
            _log.warning("the newest checkpoint needs %s: all of the map is written anew", name)
            self.last = None
            self._write_if_changed()

    def _run(self) -> None:
        lower_priority(2 * NICENESS)  # mapping has priority, too
        due = time.monotonic() + self._period_s
        while not self._stopping.is_set():
            self._wake.wait(due - time.monotonic() if self._period_s > 0 else None)
            self._wake.clear()
            self._run_jobs()
            if self._period_s > 0 and time.monotonic() >= due:
                self._write_if_changed()
                due = time.monotonic() + self._period_s
            self._fold()

    def _run_jobs(self) -> None:
        while not self._asked.empty():
            asked = self._asked.get()
            try:
                asked.result.set_result(asked.run())
            except Exception as error:
                asked.result.set_exception(error)

    def _write_if_changed(self) -> None:
        try:
            self.write()
        except StoreError:
            return  # the status and the log report it
        except Exception:
            self.error = "an internal error of the server; its log has the details"
            _log.exception("a checkpoint met an internal error")

    def write(self) -> CheckpointInfo:
        """Write what changed, as :meth:`answer` does; only for jobs on this thread.

        Raises:
            StoreError: it cannot be written.
        """
        assert self._store is not None
        base = self._store.base_epoch
        return self.write_changes(self._snapshot_since(base))

    def write_changes(self, snapshot: MapSnapshot) -> CheckpointInfo:
        """Write what changed since the last checkpoint; only for jobs on this thread.

        Raises:
            StoreError: it cannot be written.
        """
        assert self._store is not None
        last = self.last
        # The base is the last checkpoint, as long as its files are as they were written.
        if last is not None and last.epoch == snapshot.epoch.number == self._store.base_epoch:
            return last
        started = time.monotonic()
        try:
            changes = snapshot.changes()
            del snapshot  # the records have all of it, and memory is shortest now
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
        """Write the changes, or all of the map if earlier checkpoints were damaged since."""
        try:
            return store.write(changes)
        except StoreBaseError as error:
            _log.warning("%s; all of the map is written instead", error)
            return store.write(self._snapshot_since(None).changes())

    def _snapshot_since(self, base: int | None) -> MapSnapshot:
        """Return what a checkpoint that follows the epoch ``base`` needs."""
        return self._mapper.call(lambda mapper: mapper.snapshot_since(base))

    def _fold(self) -> None:
        """Fold old checkpoints together, if there are many."""
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

    def _kept(self) -> str:
        return "the server started" if self.last is None else f"epoch {self.last.epoch}"

    def _interrupted(self) -> bool:
        """Return whether something is more urgent than folding, which can be begun again."""
        return self._stopping.is_set() or not self._asked.empty()
