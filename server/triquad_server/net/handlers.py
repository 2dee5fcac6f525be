"""Where requests are received, wait in a bounded queue, and are handled by workers."""

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh
from triquad_format.errors import RefusedError
from triquad_format.wire import keys

from triquad_server.counter import Counter
from triquad_server.net.request import Request

_log = logging.getLogger(__name__)

Handler = Callable[[Request], None]
"""Reads the request and answers it, or raises :class:`RefusedError`."""


@dataclass(frozen=True)
class _Job:
    """A request and what handles it."""

    request: Request
    handler: Handler


class RequestDesk:
    """Some operations that share a queue and workers, so that they hold up no others."""

    def __init__(
        self,
        session: zenoh.Session,
        map_name: str,
        operations: dict[str, Handler],
        workers: int,
        limit: int,
        max_bytes: int,
        refused: Counter,
    ) -> None:
        """Begin to serve ``operations`` (handlers by operation of :mod:`triquad_format.wire.keys`).

        At most ``limit`` requests wait, each of at most ``max_bytes``.
        """
        self._max_bytes = max_bytes
        self._jobs: queue.Queue[_Job | None] = queue.Queue(limit)
        self._refused = refused
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._receivers: list[threading.Thread] = []
        self._workers = [
            threading.Thread(target=self._work, name=f"worker-{number}")
            for number in range(workers)
        ]
        for operation, handler in operations.items():
            key = keys.operation_key(map_name, operation)
            queryable = session.declare_queryable(
                key, zenoh.handlers.FifoChannel(limit), complete=True
            )
            self._queryables.append(queryable)
            self._receivers.append(
                threading.Thread(
                    target=self._receive, args=(queryable, key, handler), name=operation
                ),
            )
        for thread in self._receivers + self._workers:
            thread.start()

    def close(self) -> None:
        """Take no more requests, and handle those that wait."""
        for queryable in self._queryables:
            queryable.undeclare()
        for thread in self._receivers:
            thread.join()
        for _ in self._workers:
            self._jobs.put(None)
        for thread in self._workers:
            thread.join()

    def _receive(self, queryable: zenoh.Queryable[Any], key: str, handler: Handler) -> None:
        """Empty the channel at once: a full one would stall the network's threads."""
        for query in queryable:
            request = Request(query, key, self._refused)
            if request.size > self._max_bytes:
                text = f"{request.size} bytes exceed the limit of {self._max_bytes}: split it"
                request.refuse("too_large", text)
                continue
            try:
                self._jobs.put_nowait(_Job(request, handler))
            except queue.Full:
                request.refuse("busy", f"{self._jobs.maxsize} requests wait already; try later")

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job.handler(job.request)
            except RefusedError as error:
                job.request.refuse(error.code, error.message)
            except Exception as error:
                _log.exception("a request met a defect")
                job.request.refuse("internal", f"{type(error).__name__}: {error}")
