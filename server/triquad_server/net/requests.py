"""Requests: received, kept in a bounded queue, handled by workers, and answered exactly once."""

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import zenoh
from triquad_format.errors import ProtocolVersionError, RefusedError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import ErrorReply
from triquad_format.wire.metrics_messages import QueueMetrics

from triquad_server.net.operation_counts import OperationCounts

_log = logging.getLogger(__name__)

RequestT = TypeVar("RequestT", bound=Message)

_POINT_BYTES = 12
_OTHER_BYTES = 4096  # the largest message takes less without its points


def payload_limit(points: int) -> int:
    """Most bytes that a message of so many points may have: what is larger is not decoded."""
    return points * _POINT_BYTES + _OTHER_BYTES


class Request:
    """A query that waits for its answer."""

    def __init__(self, query: zenoh.Query, key: str, counts: OperationCounts) -> None:
        """``key`` is the key of the operation, whose ``counts`` tell what becomes of it."""
        self.key = key
        self._query = query
        self._counts = counts
        self._arrived_s = counts.arrive(self.size)

    @property
    def size(self) -> int:
        """Bytes of the payload."""
        payload = self._query.payload
        return 0 if payload is None else len(payload)

    def begin(self) -> None:
        """It is its turn."""
        self._counts.begin(self._arrived_s)

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


class RequestHandlers:
    """A group of operations that share a queue and workers, so that no other waits for them."""

    def __init__(
        self,
        session: zenoh.Session,
        operations: Mapping[str, Operation],
        *,
        workers: int,
        waiting: int,
        max_bytes: int,
    ) -> None:
        """Begin to serve ``operations``, by key.

        At most ``waiting`` requests, of ``max_bytes`` each, wait for one of the ``workers``.
        """
        self._operations = operations
        self._max_bytes = max_bytes
        self._waiting: queue.Queue[Request | None] = queue.Queue(waiting)
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._receivers: list[threading.Thread] = []
        self._workers = [
            threading.Thread(target=self._work, name=f"worker-{number}")
            for number in range(workers)
        ]
        for key in operations:
            channel = zenoh.handlers.FifoChannel(waiting)
            queryable = session.declare_queryable(key, channel, complete=True)
            receive = threading.Thread(
                target=self._receive, args=(queryable, key), name=f"receiver-{key}"
            )
            self._queryables.append(queryable)
            self._receivers.append(receive)
        for thread in self._receivers + self._workers:
            thread.start()

    @property
    def queue(self) -> QueueMetrics:
        """What waits for a worker."""
        return QueueMetrics(self._waiting.qsize(), self._waiting.maxsize)

    def close(self) -> None:
        """Take no more requests, and handle those that wait."""
        for queryable in self._queryables:
            queryable.undeclare()
        for thread in self._receivers:
            thread.join()
        for _ in self._workers:
            self._waiting.put(None)
        for thread in self._workers:
            thread.join()

    def _receive(self, queryable: zenoh.Queryable[Any], key: str) -> None:
        """Empty the channel at once: a full one would stall the network's threads."""
        for query in queryable:
            if str(query.key_expr) != key:
                query.drop()  # unanswered: who means it names it
                continue
            request = Request(query, key, self._operations[key].counts)
            if request.size > self._max_bytes:
                text = f"{request.size} bytes exceed the limit of {self._max_bytes}: split it"
                request.refuse("too_large", text)
                continue
            try:
                self._waiting.put_nowait(request)
            except queue.Full:
                request.refuse("busy", f"{self._waiting.maxsize} requests wait already; try later")

    def _work(self) -> None:
        while (request := self._waiting.get()) is not None:
            request.begin()
            try:
                self._operations[request.key].handle(request)
            except RefusedError as error:
                request.refuse(error.code, error.message)
            except Exception as error:
                request.fail(error)
