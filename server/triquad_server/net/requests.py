"""Requests: received, kept in a bounded queue, handled by workers, and answered exactly once."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import zenoh
from triquad_format.errors import ProtocolVersionError, RefusedError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import ErrorReply
from triquad_format.wire.metrics_messages import QueueMetrics

from triquad_server.asking_client import asking_client
from triquad_server.net.askers import Asker, Askers
from triquad_server.net.operation_counts import OperationCounts
from triquad_server.net.request_queue import MOST_BEGUN, MOST_SENDING, Job, RequestQueue

_log = logging.getLogger(__name__)

RequestT = TypeVar("RequestT", bound=Message)

_POINT_BYTES = 12
_OTHER_BYTES = 4096  # the largest message takes less without its points


_SLICE_POINTS = 1024
"""Points of a slice of a long request while others ask as well: some milliseconds of one core."""

_QUICK_SLICES = 16
"""So many slices of a request follow each other; then it rests, while others ask as well."""

_REST = 2.0
"""How many times as long as a slice took: mapping and the network need the cores, too."""

_LONGEST_REST_S = 0.1

_SLICE_ALONE_POINTS = 65_536

_REFUSALS = 2  # threads that send them


def payload_limit(points: int) -> int:
    """Most bytes that a message of so many points may have: what is larger is not decoded."""
    return points * _POINT_BYTES + _OTHER_BYTES


@dataclass(frozen=True)
class Turns:
    """When a request is worked at, as its group has it."""

    pause: Callable[[], None]  # returns when it is the request's turn again
    send: Callable[[], None]  # its reply is on its way
    problem: Callable[[], str | None]  # why nobody is answered any more


class Request:
    """A query that waits for its answer."""

    def __init__(
        self, query: zenoh.Query, key: str, counts: OperationCounts, asker: Asker, askers: Askers
    ) -> None:
        """``key`` is the key of the operation, whose ``counts`` tell what becomes of it.

        ``asker`` is whose it is, of all ``askers``.
        """
        self.key = key
        self.asker = asker
        self._query = query
        self._counts = counts
        self._askers = askers
        self._turns: Turns | None = None
        self._slices = 0  # that have begun
        self._slice_began_s = 0.0  # monotonic
        self._arrived_s = counts.arrive(self.size)

    @property
    def size(self) -> int:
        """Bytes of the payload."""
        payload = self._query.payload
        return 0 if payload is None else len(payload)

    def begin(self, turns: Turns) -> None:
        """It is its turn.

        Raises:
            RefusedError: nobody waits for the answer any more, or the server is stopping.
        """
        self._turns = turns
        self._counts.begin(self._arrived_s)
        self._check()

    def turn(self) -> int:
        """Return when it is its turn again; how many points may be searched around then.

        Raises:
            RefusedError: nobody waits for the answer any more, or the server is stopping.
        """
        several = self._askers.are_several
        if several and self._slices > _QUICK_SLICES:
            took_s = time.monotonic() - self._slice_began_s
            time.sleep(min(_REST * took_s, _LONGEST_REST_S))
        if self._turns is not None:
            self._turns.pause()
        self._check()
        self._slices += 1
        self._slice_began_s = time.monotonic()
        return _SLICE_POINTS if several else _SLICE_ALONE_POINTS

    def _check(self) -> None:
        if self._turns is not None and (problem := self._turns.problem()) is not None:
            raise RefusedError("busy", problem)
        if self._askers.has_left(self.asker):
            raise RefusedError("timeout", "the client has left")
        if time.monotonic() > self.asker.deadline_s:
            raise RefusedError("timeout", "there was no time to finish: ask for less at once")

    def read(self, kind: type[RequestT]) -> RequestT:
        """The request's message.

        Raises:
            RefusedError: there is none, or it cannot be decoded.
        """
        payload = self._query.payload
        if payload is None:
            raise RefusedError("bad_request", f"no payload: expected a {kind.__name__}")
        try:
            return codec.decode(kind, payload.to_bytes())
        except ProtocolVersionError as error:
            raise RefusedError("bad_version", str(error)) from error
        except WireError as error:
            raise RefusedError("bad_request", str(error)) from error

    def answer(self, message: Message) -> None:
        """Reply with ``message``."""
        payload = codec.encode(message)
        self._finish(
            lambda: self._query.reply(self.key, payload, encoding=keys.encoding(type(message)))
        )
        self._counts.answer(self._arrived_s, len(payload))

    def refuse(self, code: str, text: str) -> None:
        """Reply with an error; ``code`` is one of ``ERROR_CODES``."""
        self._counts.refuse(code)
        _log.debug("request on %s refused (%s): %s", self.key, code, text)
        payload = codec.encode(ErrorReply(code, text[:4096]))
        self._finish(lambda: self._query.reply_err(payload, encoding=keys.encoding(ErrorReply)))

    def fail(self, error: Exception) -> None:
        """Reply that handling the request met an internal error, which is being handled.

        Too little memory is none: another request may be answered.
        """
        if isinstance(error, MemoryError):
            self.refuse("busy", "the server has too little memory for this; ask for less, or later")
            return
        _log.exception("a request on %s met an internal error", self.key)
        self.refuse("internal", f"{type(error).__name__}: {error}")

    def _finish(self, reply: Callable[[], None]) -> None:
        """Send the reply and end the query, also where the one who asked is gone."""
        if self._turns is not None:
            self._turns.send()
        try:
            with self._query:
                reply()
        except zenoh.ZError as error:
            _log.warning("no answer could be sent on %s: %s", self.key, error)


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


_STOPPING = "the server is stopping"


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
        *,
        workers: int,
        limits: RequestLimits,
    ) -> None:
        """Begin to serve ``operations``, by key, with so many ``workers``."""
        self._operations = operations
        self._askers = askers
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
        self._workers = ThreadPoolExecutor(max(MOST_BEGUN, workers) + MOST_SENDING, "worker")
        self._refusals = ThreadPoolExecutor(_REFUSALS, "refusals")
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._receivers: list[threading.Thread] = []
        for key in operations:
            channel = zenoh.handlers.FifoChannel(limits.waiting)
            queryable = session.declare_queryable(key, channel, complete=True)
            receive = threading.Thread(
                target=self._receive, args=(queryable, key), name=f"receiver-{key}"
            )
            self._queryables.append(queryable)
            self._receivers.append(receive)
        for thread in self._receivers:
            thread.start()

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
        for thread in self._receivers:
            thread.join()
        self.stop()
        self._workers.shutdown()
        self._refusals.shutdown()

    def _receive(self, queryable: zenoh.Queryable[Any], key: str) -> None:
        """Empty the channel at once: a full one would stall the network's threads."""
        for query in queryable:
            if str(query.key_expr) != key:
                query.drop()  # unanswered: who means it names it
                continue
            asker = self._askers.asker(query, self._limits.longest_s)
            request = Request(query, key, self._operations[key].counts, asker, self._askers)
            if request.size > self._limits.max_bytes:
                limit = self._limits.max_bytes
                text = f"{request.size} bytes exceed the limit of {limit}: split it"
                self._refuse_aside(request, "too_large", text)
            elif self._stopping:
                self._refuse_aside(request, "busy", _STOPPING)
            else:
                for excess in self._queue.put(asker.owner, request, request.size):
                    text = f"{self._limits.waiting} requests wait already; try later"
                    self._refuse_aside(excess, "busy", text)

    def _refuse_aside(self, request: Request, code: str, text: str) -> None:
        """Refuse a request in another thread: its client may not take the reply."""
        self._refusals.submit(request.refuse, code, text)

    def _begin(self, job: Job[Request]) -> None:
        self._workers.submit(self._work, job)

    def _work(self, job: Job[Request]) -> None:
        request = job.request
        turns = Turns(
            pause=lambda: self._queue.pause(job),
            send=lambda: self._queue.send(job),
            problem=lambda: _STOPPING if self._stopping else None,
        )
        asking_client.set(request.asker.owner.group)
        try:
            request.begin(turns)
            self._operations[request.key].handle(request)
        except RefusedError as error:
            request.refuse(error.code, error.message)
        except Exception as error:
            request.fail(error)
        finally:
            self._queue.finish(job)
