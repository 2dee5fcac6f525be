"""A request until it is answered."""

import logging
from collections.abc import Callable
from typing import TypeVar

import zenoh
from triquad_format.errors import ProtocolVersionError, RefusedError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import ErrorReply

from triquad_server.fair_queue import Owner
from triquad_server.serving.operation_counts import OperationCounts

_log = logging.getLogger(__name__)

RequestT = TypeVar("RequestT", bound=Message)


def payload_size(query: zenoh.Query) -> int:
    """Return the number of bytes of a query's payload."""
    return 0 if query.payload is None else len(query.payload)


class Request:
    """A query that waits for its answer."""

    def __init__(
        self,
        query: zenoh.Query,
        key: str,
        counts: OperationCounts,
        owner: Owner,
        deadline_s: float,
        sends: Callable[["Request", int], bool],
    ) -> None:
        """Make a request; ``key`` is that of the operation, whose ``counts`` record the result.

        ``owner`` is the client session, which waits until ``deadline_s``, monotonic. ``sends`` is
        called before a reply of N bytes is sent, which takes as long as the client likes;
        a reply that it rejects is not sent.
        """
        self.key = key
        self.owner = owner
        self.deadline_s = deadline_s
        self._query = query
        self._counts = counts
        self._sends = sends
        self._arrived_s = counts.arrive(self.size)

    @property
    def size(self) -> int:
        """The number of bytes of the payload."""
        return payload_size(self._query)

    def begin(self) -> None:
        """Count the time that the request waited for a worker."""
        self._counts.begin(self._arrived_s)

    def read(self, kind: type[RequestT]) -> RequestT:
        """Return the request's message.

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
        """Reply with ``message``; refuse to, if large replies to others take the memory."""
        payload = codec.encode(message)
        if not self._sends(self, len(payload)):
            self.refuse("busy", "too many large replies are on their way; ask for less, or later")
            return
        self._finish(
            lambda: self._query.reply(self.key, payload, encoding=keys.encoding(type(message)))
        )
        self._counts.answer(self._arrived_s, len(payload))

    def refuse(self, code: str, text: str) -> None:
        """Reply with an error; ``code`` is one of ``ERROR_CODES``."""
        self._counts.refuse(code)
        _log.debug("request on %s refused (%s): %s", self.key, code, text)
        payload = codec.encode(ErrorReply(code, text[:4096]))
        self._sends(self, 0)
        self._finish(lambda: self._query.reply_err(payload, encoding=keys.encoding(ErrorReply)))

    def fail(self, error: Exception) -> None:
        """Reply that handling the request met an internal error, which is being handled."""
        _log.exception("a request on %s met an internal error", self.key)
        self.refuse("internal", f"{type(error).__name__}: {error}")

    def _finish(self, reply: Callable[[], None]) -> None:
        """Send the reply and end the query, even if its client has left."""
        try:
            with self._query:
                reply()
        except zenoh.ZError as error:
            _log.warning("no answer could be sent on %s: %s", self.key, error)
