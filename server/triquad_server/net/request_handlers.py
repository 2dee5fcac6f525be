"""Groups of operations, each with a queue and workers; every request is answered exactly once."""

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import zenoh
from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Message
from triquad_format.wire.metrics_messages import QueueMetrics
from triquad_map.compiled.priority import lower_priority

from triquad_server.net.askers import Askers
from triquad_server.net.asking_client import asking_client
from triquad_server.net.byte_budget import ByteBudget
from triquad_server.net.long_work import LongWork
from triquad_server.net.operation_counts import OperationCounts
from triquad_server.net.receivers import Receivers
from triquad_server.net.request import Request, RequestT, Turns
from triquad_server.net.request_queue import (
    MOST_LONG,
    MOST_SENDING,
    MOST_SHORT,
    Job,
    RequestQueue,
    SetAsideError,
)
from triquad_server.process.threads import submit

_log = logging.getLogger(__name__)

_REFUSALS = 2  # threads that send them

_REFUSED_BYTES = 4_000_000
"""Of requests that are refused in these threads: beyond, large ones are refused by the receiver,
so that the network waits for it and not they in memory."""

_LARGE_BYTES = 65_536
_STOPPING = "the server is stopping"

Handler = Callable[[Request], None]
"""Reads the request and answers it, or raises :class:`RefusedError`."""


class Operation(NamedTuple):
    """How the requests of an operation are handled, and where they are counted."""

    handle: Handler
    counts: OperationCounts


def answering(kind: type[RequestT], answer: Callable[[RequestT], Message]) -> Handler:
    """A handler that decodes a ``kind`` and replies with what ``answer`` makes of it."""

    def handle(request: Request) -> None:
        request.answer(answer(request.read(kind)))

    return handle


@dataclass(frozen=True)
class RequestLimits:
    """Bounds of what waits for the workers of a group."""

    waiting: int  # requests
    waiting_bytes: int  # of their payloads
    max_bytes: int  # of a single payload
    longest_s: float  # for which any client is believed to wait


class RequestHandlers:
    """A group of operations that share a queue and workers, so that no other waits for them."""

    def __init__(
        self,
        session: zenoh.Session,
        operations: Mapping[str, Operation],
        askers: Askers,
        long_work: LongWork,
        replies: ByteBudget,
        *,
        workers: int,
        limits: RequestLimits,
        niceness: int = 0,
    ) -> None:
        """Begin to serve ``operations``, by key, with so many ``workers`` of this niceness.

        ``askers``, ``long_work`` and ``replies`` are those of all groups.
        """
        self._operations = operations
        self._askers = askers
        self._long_work = long_work
        self._replies = replies
        self._limits = limits
        self._queue: RequestQueue[Request] = RequestQueue(
            self._begin,
            lambda: askers.are_several,
            workers=workers,
            limit=limits.waiting,
            limit_bytes=limits.waiting_bytes,
        )
        self._stopping = False
        # As many as ever work or send at a time; they are started when they are needed.
        most_begun = max(MOST_SHORT, workers) + MOST_LONG
        self._workers = ThreadPoolExecutor(
            most_begun + MOST_SENDING, "worker", initializer=lower_priority, initargs=(niceness,)
        )
        self._refusals = ThreadPoolExecutor(_REFUSALS, "refusals")
        self._refused = ByteBudget(_REFUSED_BYTES, small=_LARGE_BYTES)
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._receivers: list[Receivers[zenoh.Query]] = []
        for key in operations:
            channel = zenoh.handlers.FifoChannel(limits.waiting)
            queryable = session.declare_queryable(key, channel, complete=True)
            receive = partial(self._receive, key)
            self._queryables.append(queryable)
            self._receivers.append(
                Receivers(queryable, receive, name=f"receiver-{key}", niceness=niceness)
            )

    @property
    def queue(self) -> QueueMetrics:
        """What waits for a worker."""
        return self._queue.metrics

    def stop(self) -> None:
        """Refuse what waits and what comes, and end what is worked at as soon as it pauses."""
        self._stopping = True
        for request in self._queue.clear():
            self._refuse_aside(request, "busy", _STOPPING)

    def close(self) -> None:
        """As :meth:`stop`, and take no more requests."""
        for queryable in self._queryables:
            queryable.undeclare()
        self.stop()  # those who receive may be at work
        for receivers in self._receivers:
            receivers.join()
        self.stop()  # and may have taken something after that
        self._workers.shutdown()
        self._refusals.shutdown()

    def _receive(self, key: str, query: zenoh.Query) -> None:
        """Have a request wait, and work at the one whose turn it is."""
        if str(query.key_expr) != key:
            query.drop()  # unanswered: who means it names it
            return
        try:
            job = self._take(query, key)
            if job is not None:
                self._work(job)
        except MemoryError:
            _log.warning("a request on %s goes unanswered: too little memory", key)
        except Exception:  # the next one may be answered
            _log.exception("a request on %s could not be received", key)

    def _take(self, query: zenoh.Query, key: str) -> Job[Request] | None:
        """Have a request wait; returns one to begin with, if there is a worker for it."""
        asker = self._askers.asker(query, self._limits.longest_s)
        counts = self._operations[key].counts
        request = Request(query, key, counts, asker, self._askers, self._replies)
        if request.size > self._limits.max_bytes:
            limit = self._limits.max_bytes
            text = f"{request.size} bytes exceed the limit of {limit}: split it"
            self._refuse_aside(request, "too_large", text)
            return None
        if self._stopping:
            self._refuse_aside(request, "busy", _STOPPING)
            return None
        placed = self._queue.put(asker.owner, request, request.size)
        for excess in placed.excess:
            text = f"{self._limits.waiting} requests wait already; try later"
            self._refuse_aside(excess, "busy", text)
        return placed.begun

    def _refuse_aside(self, request: Request, code: str, text: str) -> None:
        """Refuse a request, in another thread mostly: its client may not take the reply."""
        if self._refused.take(request.size):
            submit(self._refusals, self._refuse, request, code, text)
        else:
            request.refuse(code, text)

    def _refuse(self, request: Request, code: str, text: str) -> None:
        size = request.size
        try:
            request.refuse(code, text)
        finally:
            self._refused.give_back(size)

    def _begin(self, job: Job[Request]) -> None:
        submit(self._workers, self._work, job)

    def _work(self, job: Job[Request]) -> None:
        request = job.request
        turns = Turns(
            pause=lambda: self._queue.pause(job),
            rest=lambda took_s: self._queue.rest(job, self._long_work.rest_s(took_s)),
            send=lambda: self._queue.send(job),
            problem=lambda: _STOPPING if self._stopping else None,
        )
        asking_client.set(request.asker.owner.group)
        try:
            request.begin(turns)
            self._operations[request.key].handle(request)
        except SetAsideError:
            self._queue.put_back(job)
            if self._stopping:  # since it did not wait until now
                self.stop()
        except RefusedError as error:
            request.refuse(error.code, error.message)
        except Exception as error:
            request.fail(error)
        finally:
            self._queue.finish(job)
