"""A request on its way to its answer."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import zenoh
from triquad_format.errors import ProtocolVersionError, RefusedError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import ErrorReply

from triquad_server.fair_queue import Owner
from triquad_server.net.askers import Asker, Askers
from triquad_server.net.byte_budget import ByteBudget
from triquad_server.net.operation_counts import OperationCounts

_log = logging.getLogger(__name__)

RequestT = TypeVar("RequestT", bound=Message)

_SLICE_POINTS = 1024
"""Points of a slice of a long request while others ask as well: some milliseconds of one core."""

_SHORT_SLICES = 4
"""A planner's request has no more of them; it does not pause between them."""

_QUICK_SLICES = 16
"""A request of more is long: it rests after each slice, while others ask as well."""

_SLICE_ALONE_POINTS = 65_536


@dataclass(frozen=True)
class Turns:
    """When a request is worked at, as its group has it."""

    pause: Callable[[], None]  # returns when it is the request's turn again
    rest: Callable[[float], None]  # as pause, some time after a slice that took so long, seconds
    send: Callable[[], None]  # its reply is on its way
    problem: Callable[[], str | None]  # why nobody is answered any more


class Request:
    """A query that waits for its answer."""

    def __init__(
        self,
        query: zenoh.Query,
        key: str,
        counts: OperationCounts,
        asker: Asker,
        askers: Askers,
        replies: ByteBudget,
    ) -> None:
        """``key`` is the key of the operation, whose ``counts`` tell what becomes of it.

        ``asker`` is whose it is, of all ``askers``; ``replies`` is that of
        the replies to all that are on their way.
        """
        self.key = key
        self.asker = asker
        self._query = query
        self._counts = counts
        self._askers = askers
        self._replies = replies
        self._turns: Turns | None = None
        self._slices = 0  # that have begun
        self._slice_began_s = 0.0  # monotonic
        self._arrived_s = counts.arrive(self.size)

    @property
    def size(self) -> int:
        """Bytes of the payload."""
        payload = self._query.payload
        return 0 if payload is None else len(payload)

    @property
    def owner(self) -> Owner:
        """Whose it is."""
        return self.asker.owner

    def begin(self, turns: Turns) -> None:
        """It is its turn; not for the first time, maybe.

        Raises:
            RefusedError: nobody waits for the answer any more, or the server is stopping.
        """
        if self._turns is None:
            self._counts.begin(self._arrived_s)
        self._turns = turns
        self._slices = 0
        self._check()

    def turn(self) -> int:
        """Return when it is its turn again; how many points may be searched around then.

        Raises:
            RefusedError: nobody waits for the answer any more, or the server is stopping.
        """
        self._askers.hear_of(self.asker)
        several = self._askers.are_several
        if self._turns is not None and self._slices >= _SHORT_SLICES:
            if several and self._slices >= _QUICK_SLICES:
                self._turns.rest(time.monotonic() - self._slice_began_s)
            else:
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
        """Reply with ``message``; refuse to, where it is large and others that are on their way
        take the memory.
        """
        payload = codec.encode(message)
        if not self._replies.take(len(payload)):
            self.refuse("busy", "too many large replies are on their way; ask for less, or later")
            return
        try:
            self._finish(
                lambda: self._query.reply(self.key, payload, encoding=keys.encoding(type(message)))
            )
        finally:
            self._replies.give_back(len(payload))
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
