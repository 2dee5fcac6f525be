"""The operations that a server answers: each has a key, and all share two queues."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Any

import zenoh
from triquad_format.errors import RefusedError
from triquad_format.wire import keys
from triquad_format.wire.codec import Message
from triquad_format.wire.limits import MAX_WAIT_S
from triquad_format.wire.metrics_messages import QueueMetrics
from triquad_map.compiled.team import THREADS

from triquad_server.fair_queue import Owner
from triquad_server.process.threads import submit
from triquad_server.serving.client_sessions import ClientSessions
from triquad_server.serving.operation_counts import OperationCounts
from triquad_server.serving.refusals import Refusals
from triquad_server.serving.request import Request, RequestT
from triquad_server.serving.request_queue import MOST_SENDING, QueueLimits, RequestQueue
from triquad_server.settings import ServiceSettings

_log = logging.getLogger(__name__)

_WORKERS = max(2, THREADS)  # for queries: one per core
_ADMINISTRATION_WORKERS = 2
_QUEUE_BYTES = 64_000_000  # of the requests of all clients that wait
_PLAIN_BYTES = 16_384  # of a request that holds neither points nor tiles
_SLOW = "slow"
"""The group of all requests that may take seconds: one of all clients is handled at a time."""

_STOPPING = "the server is stopping"

Handler = Callable[[Request], None]
"""Reads the request and answers it, or raises :class:`RefusedError`."""

ReadQueue = Callable[[], QueueMetrics]
"""Returns the state of a queue now."""


class Lane(Enum):
    """The queue in which the requests of an operation wait."""

    QUESTIONS = "questions"
    ADMINISTRATION = "administration"
    """The lane of what takes no time: it is answered however many queries wait."""

    SLOW = "slow"
    """The lane of administration that may take seconds, one after the other."""


@dataclass(frozen=True)
class _Operation:
    handle: Handler
    counts: OperationCounts
    lane: Lane
    queue: RequestQueue[Request]
    max_bytes: int


def answering(kind: type[RequestT], answer: Callable[[RequestT], Message]) -> Handler:
    """Return a handler that decodes a ``kind`` and replies with the result of ``answer``."""

    def handle(request: Request) -> None:
        request.answer(answer(request.read(kind)))

    return handle


class Operations:
    """Receives the requests of one map, and has them handled: each is answered exactly once."""

    def __init__(
        self,
        session: zenoh.Session,
        map_name: str,
        settings: ServiceSettings,
        give_way: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin; ``give_way`` returns when a query may begin, as far as other work is concerned."""
        self._session = session
        self._map_name = map_name
        self._give_way = give_way
        self._sessions = ClientSessions(session)
        self._refusals = Refusals()
        self._operations: dict[str, _Operation] = {}  # by key
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._pools: list[ThreadPoolExecutor] = []
        limits = QueueLimits(settings.request_queue, _QUEUE_BYTES)
        self._questions = self._queue("worker", _WORKERS, limits)
        self._administration = self._queue("administration", _ADMINISTRATION_WORKERS, limits)
        self._stopping = self._closed = False
        self.counts: dict[str, OperationCounts] = {}  # by operation, such as "query/sdf"
        self.queues: dict[str, ReadQueue] = {  # by name
            "questions": lambda: self._questions.metrics,
            "administration": lambda: self._administration.metrics,
        }

    @property
    def own_name(self) -> str:
        """The name of the server in a request to itself, to have turns of its own."""
        return self._sessions.own_name

    def serve(
        self,
        name: str,
        handle: Handler,
        lane: Lane = Lane.QUESTIONS,
        max_bytes: int = _PLAIN_BYTES,
    ) -> None:
        """Answer an operation from now on; requests larger than ``max_bytes`` are refused."""
        key = keys.operation_key(self._map_name, name)
        counts = self.counts[name] = OperationCounts()
        queue = self._questions if lane is Lane.QUESTIONS else self._administration
        self._operations[key] = _Operation(handle, counts, lane, queue, max_bytes)
        # This runs in the network's own threads, so it only queues requests.
        receive = zenoh.handlers.Callback(partial(self._receive, key), indirect=False)
        self._queryables.append(self._session.declare_queryable(key, receive, complete=True))

    def stop(self) -> None:
        """Refuse all waiting and new requests."""
        self._stopping = True
        for queue in (self._questions, self._administration):
            for request in queue.clear():
                self._refusals.add(request, "busy", _STOPPING)

    def close(self) -> None:
        """Do as :meth:`stop`; return once all work is answered. Closing twice does no harm."""
        if self._closed:
            return
        self._closed = True
        self.stop()
        for queryable in self._queryables:
            queryable.undeclare()
        self.stop()  # requests may have arrived meanwhile
        for pool in self._pools:
            pool.shutdown()
        self._refusals.close()
        self._sessions.close()

    def _queue(self, name: str, workers: int, limits: QueueLimits) -> RequestQueue[Request]:
        """Return a queue with workers, whose threads are started when they are needed."""
        pool = ThreadPoolExecutor(workers + MOST_SENDING, name)
        self._pools.append(pool)
        return RequestQueue(
            lambda request: submit(pool, self._work, request), workers=workers, limits=limits
        )

    def _receive(self, key: str, query: zenoh.Query) -> None:
        if str(query.key_expr) != key:
            query.drop()  # unanswered: a client that means it names it
            return
        try:
            self._take(key, query)
        except Exception:  # the next one may be answered
            _log.exception("a request on %s could not be received", key)

    def _take(self, key: str, query: zenoh.Query) -> None:
        """Queue a request, or refuse it."""
        operation = self._operations[key]
        source = self._sessions.source(query, MAX_WAIT_S)
        owner = source.owner
        if operation.lane is Lane.SLOW:
            owner = Owner(_SLOW, owner.name)
        request = Request(
            query, key, operation.counts, owner, source.deadline_s, operation.queue.send
        )
        if request.size > operation.max_bytes:
            text = f"{request.size} bytes exceed the limit of {operation.max_bytes}: split it"
            self._refusals.add(request, "too_large", text)
        elif self._stopping:
            self._refusals.add(request, "busy", _STOPPING)
        else:
            for excess in operation.queue.put(request, request.size):
                text = "too many requests wait already, most of them of this client; try later"
                self._refusals.add(excess, "busy", text)

    def _work(self, request: Request) -> None:
        operation = self._operations[request.key]
        try:
            request.begin()
            if operation.lane is Lane.QUESTIONS:
                self._give_way()
            self._check(request)
            operation.handle(request)
        except RefusedError as error:
            request.refuse(error.code, error.message)
        except Exception as error:
            request.fail(error)
        finally:
            operation.queue.finish(request)

    def _check(self, request: Request) -> None:
        """Refuse a request whose client no longer waits."""
        if self._stopping:
            raise RefusedError("busy", _STOPPING)
        if self._sessions.have_left(request.owner):
            raise RefusedError("timeout", "the client has left")
        if time.monotonic() > request.deadline_s:
            raise RefusedError("timeout", "there was no time to answer: ask for less at once")
