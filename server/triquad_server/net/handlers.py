"""Where requests are received, wait in a bounded queue, and are handled by workers."""

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import zenoh
from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Message

from triquad_server.counter import Counter
from triquad_server.net.request import Request

_log = logging.getLogger(__name__)

Handler = Callable[[Request], None]
"""Reads the request and answers it, or raises :class:`RefusedError`."""

RequestT = TypeVar("RequestT", bound=Message)


def answering(kind: type[RequestT], answer: Callable[[RequestT], Message]) -> Handler:
    """A handler that decodes a ``kind`` and replies with what ``answer`` makes of it."""

    def handle(request: Request) -> None:
        request.answer(answer(request.read(kind)))

    return handle


@dataclass(frozen=True)
class HandlerLimits:
    """What a group of operations may take up."""

    workers: int
    waiting: int  # requests that wait for a worker at most
    request_bytes: int  # of each request


@dataclass(frozen=True)
class _Job:
    """A request and what handles it."""

    request: Request
    handler: Handler


class RequestHandlers:
    """A group of operations that share a queue and workers, so that no other waits for them."""

    def __init__(
        self,
        session: zenoh.Session,
        operations: Mapping[str, Handler],
        limits: HandlerLimits,
        refused: Counter,
    ) -> None:
        """Begin to serve ``operations``: handlers by key. What is refused is counted."""
        self._limits = limits
        self._jobs: queue.Queue[_Job | None] = queue.Queue(limits.waiting)
        self._refused = refused
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._receivers: list[threading.Thread] = []
        self._workers = [
            threading.Thread(target=self._work, name=f"worker-{number}")
            for number in range(limits.workers)
        ]
        for key, handler in operations.items():
            channel = zenoh.handlers.FifoChannel(limits.waiting)
            queryable = session.declare_queryable(key, channel, complete=True)
            receive = threading.Thread(
                target=self._receive, args=(queryable, key, handler), name=f"receiver-{key}"
            )
            self._queryables.append(queryable)
            self._receivers.append(receive)
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
            limit = self._limits.request_bytes
            if request.size > limit:
                text = f"{request.size} bytes exceed the limit of {limit}: split it"
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
                _log.exception("a request met an internal error")
                job.request.refuse("internal", f"{type(error).__name__}: {error}")
