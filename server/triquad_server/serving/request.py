"""A request, who sent it, and its answer; and the counts of each operation's results and times."""

import logging
import threading
import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import zenoh
from triquad_format.errors import ProtocolVersionError, RefusedError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.bounds import check_question
from triquad_format.wire.codec import Message, MessageT
from triquad_format.wire.limits import MAX_WAIT_S
from triquad_format.wire.messages import ErrorReply, read_origin
from triquad_format.wire.metrics_messages import OperationMetrics, TimeHistogram

from triquad_server.fair_queue import Owner

_log = logging.getLogger(__name__)

BOUNDS_S = tuple(
    round(step * 10.0**power, 6) for power in range(-4, 2) for step in (1, 1.8, 3.2, 5.6)
)
"""The upper bounds of the buckets: four a decade, 0.1 ms to 56 s."""

_UNLINKED = ""
"""The group of all clients that are not linked to the server itself: they take one turn together,
since any name can be invented."""

_GRACE_S = 0.5  # a request is handled for this much longer: its client's own time-out comes first
_FRESH_S = 1.0  # so long a session may have left unnoticed


class Times:
    """A histogram of times; not safe for several threads at once."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def add(self, time_s: float) -> None:
        """Count something that took ``time_s`` seconds."""
        self._counts[bisect_left(BOUNDS_S, time_s)] += 1
        self._sum_s += time_s

    def histogram(self) -> TimeHistogram:
        """Return the counts so far."""
        return TimeHistogram(np.array(self._counts, np.int64), self._sum_s)


class OperationCounts:
    """Counts the requests of one operation; safe for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._answers, self._waits = Times(), Times()
        self._refused: dict[str, int] = {}
        self._pending = 0
        self._received_bytes = self._sent_bytes = 0

    def arrive(self, size: int) -> float:
        """Record a request of ``size`` bytes that arrived; return the time, monotonic seconds."""
        with self._lock:
            self._pending += 1
            self._received_bytes += size
        return time.monotonic()

    def begin(self, arrived_s: float) -> None:
        """Record that a worker begins with a request."""
        waited_s = time.monotonic() - arrived_s
        with self._lock:
            self._waits.add(waited_s)

    def answer(self, arrived_s: float, size: int) -> None:
        """Record that a request was answered with ``size`` bytes."""
        took_s = time.monotonic() - arrived_s
        with self._lock:
            self._pending -= 1
            self._sent_bytes += size
            self._answers.add(took_s)

    def refuse(self, code: str) -> None:
        """Record that a request was refused; ``code`` is one of ``ERROR_CODES``."""
        with self._lock:
            self._pending -= 1
            self._refused[code] = self._refused.get(code, 0) + 1

    def metrics(self) -> OperationMetrics:
        """Return the counts so far."""
        with self._lock:
            return OperationMetrics(
                answers=self._answers.histogram(),
                waits=self._waits.histogram(),
                refused=dict(self._refused),
                pending=self._pending,
                received_bytes=self._received_bytes,
                sent_bytes=self._sent_bytes,
            )


@dataclass(frozen=True)
class Source:
    """The owner of a request, and what its sender says of it."""

    owner: Owner
    deadline_s: float  # monotonic: until then the answer is waited for
    local: bool = False  # places count from the map's origin


class ClientSessions:
    """Finds the session of a request; safe for any thread.

    A client that is linked and names itself has turns of its own. Those that come through a
    router, or give no name, share turns: Zenoh does not show from which link a request
    came, but invented names are no links.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._info = session.info
        self._linked = frozenset[str]()  # Zenoh ids at the other ends of links
        self._read_s = 0.0  # when that was, monotonic

    def source(self, query: zenoh.Query) -> Source:
        """Return a request's owner and deadline; no longer wait than ``MAX_WAIT_S`` is believed."""
        attachment = query.attachment
        origin = None if attachment is None else read_origin(attachment.to_bytes())
        now = time.monotonic()
        if origin is None:
            return Source(Owner(_UNLINKED), now + MAX_WAIT_S)
        # Written so that NaN counts as not given.
        wait_s = origin.timeout_s if 0 <= origin.timeout_s <= MAX_WAIT_S else MAX_WAIT_S
        group = origin.client if self._is_linked(origin.client) else _UNLINKED
        return Source(Owner(group, origin.client), now + wait_s + _GRACE_S, origin.local)

    def have_left(self, owner: Owner) -> bool:
        """Return whether the link to the client that sent a request is closed."""
        return owner.group != _UNLINKED and not self._is_linked(owner.group)

    def _is_linked(self, name: str) -> bool:
        now = time.monotonic()
        # A new client may send requests at once.
        if name not in self._linked or now > self._read_s + _FRESH_S:
            ids = (str(transport.zid) for transport in self._info.transports())
            self._linked, self._read_s = frozenset(ids), now
        return name in self._linked


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
        source: Source,
        sends: Callable[["Request", int], bool],
    ) -> None:
        """Make a request; ``key`` is that of the operation, whose ``counts`` record the result.

        ``source`` is who asks, and how. ``sends`` is called
        before a reply of N bytes is sent, which takes as long as the client likes; a reply that it
        rejects is not sent.
        """
        self.key = key
        self.owner = source.owner
        self.deadline_s = source.deadline_s  # monotonic
        self.local = source.local  # places count from the map's origin
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

    def read(self, kind: type[MessageT]) -> MessageT:
        """Return the request's message.

        Raises:
            RefusedError: there is none, it cannot be decoded, or a field is out of bounds.
        """
        payload = self._query.payload
        if payload is None:
            raise RefusedError("bad_request", f"no payload: expected a {kind.__name__}")
        try:
            message = codec.decode(kind, payload.to_bytes())
            check_question(message)
            return message
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
