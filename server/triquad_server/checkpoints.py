"""When checkpoints are written: now and then, on request, and at the end."""

import logging
import threading

from triquad_format.messages import CheckpointInfo, CheckpointRequest

from triquad_server.errors import RequestError, StoreError
from triquad_server.mapper_thread import MapperThread
from triquad_server.store import Store

_log = logging.getLogger(__name__)

_NO_STORE = "the server was started without --store: the map is not kept"


class Checkpoints:
    """Writes the map to its store. A store that fails never stops the mapping."""

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
        self._writing = threading.Lock()
        self._stopping = threading.Event()
        self.last = last
        self.error = None if store else _NO_STORE
        self._thread = threading.Thread(target=self._run, name="checkpoints")

    def start(self) -> None:
        """Begin to write checkpoints while the map changes."""
        if self._store is not None and self._period_s > 0:
            self._thread.start()

    def close(self) -> None:
        """Write a last checkpoint, if the map changed since the one before."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        if self._store is not None:
            self._write_if_changed()

    def answer(self, _request: CheckpointRequest) -> CheckpointInfo:
        """A checkpoint of the map as it is now; the last one where nothing changed."""
        try:
            return self._write()
        except StoreError as error:
            raise RequestError("store", str(error)) from error

    def _run(self) -> None:
        while not self._stopping.wait(self._period_s):
            self._write_if_changed()

    def _write_if_changed(self) -> None:
        try:
            self._write()
        except StoreError:
            return  # noted in the status and in the log
        except Exception:
            self.error = "a defect of the server; its log has the details"
            _log.exception("a checkpoint met a defect")

    def _write(self) -> CheckpointInfo:
        if self._store is None:
            raise StoreError(_NO_STORE)
        with self._writing:
            epoch = self._mapper.call(lambda mapper: mapper.publish().number)
            if self.last is not None and self.last.epoch == epoch:
                return self.last
            try:
                info = self._store.write(self._mapper.call(lambda mapper: mapper.record(True)))
            except StoreError as error:
                self.error = str(error)
                _log.error("%s", error)
                raise
            self.last, self.error = info, None
            _log.info("checkpoint %s: epoch %d, %d bytes", info.path, info.epoch, info.bytes)
            return info
