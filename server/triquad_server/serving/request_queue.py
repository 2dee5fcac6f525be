"""The queue of requests: client sessions take turns at a few workers."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import zenoh
from triquad_format.wire.limits import MAX_WAIT_S
from triquad_format.wire.messages import read_origin
from triquad_format.wire.metrics_messages import QueueMetrics

from triquad_server.fair_queue import FairQueue, Owner

MOST_SENDING = 32
"""The replies being sent at a time, which clients may not read, each in a thread. Zenoh gives up a
client that has taken nothing for five seconds."""

_SENDING_EACH = 2
"""The replies being sent to one client: no more of its requests are handled until it takes one."""

_SESSIONS_WAITING = 8
"""The number of sessions that may each have the full number of requests wait; more share that."""

_REPLY_BYTES = 32_000_000
"""The bytes of all replies being sent; a large one beyond is refused."""

_SMALL_REPLY_BYTES = 262_144
"""The most bytes of a reply, such as a planner's, that is never refused."""


_UNLINKED = ""
"""The group of all clients that are not linked to the server itself: they take one turn together,
since any name can be invented."""

_GRACE_S = 0.5  # a request is handled for this much longer: its client's own time-out comes first
_FRESH_S = 1.0  # so long a session may have left unnoticed


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


class Owned(Protocol):
    """An item in the queue."""

    owner: Owner


RequestT = TypeVar("RequestT", bound=Owned)


class RequestQueue(Generic[RequestT]):
    """A bounded queue of requests, each handled by one of some workers; safe for any thread.

    A session has at most half of the workers, so that one is left for the next. A request occupies
    its worker until its reply is made: while that is sent, another may begin.
    """

    def __init__(
        self, begin: Callable[[RequestT], None], *, workers: int, requests_each: int, nbytes: int
    ) -> None:
        """Begin with no requests; ``begin`` has a thread handle a request, and returns at once.

        At most ``requests_each`` of one client session wait, and ``nbytes`` of all together.
        """
        self._begin = begin
        self._workers = workers
        self._most_each = max(1, workers // 2)
        self._lock = threading.Lock()
        self._waiting: FairQueue[RequestT] = FairQueue(
            requests_each * _SESSIONS_WAITING,
            nbytes,
            requests_each,
            newest_go=True,
        )
        self._working: dict[RequestT, float] = {}  # with the time of their begin, monotonic
        self._sending: dict[RequestT, int] = {}  # with the bytes of the reply

    @property
    def metrics(self) -> QueueMetrics:
        """Return the state of the requests that wait for a worker."""
        with self._lock:
            return QueueMetrics(len(self._waiting), self._waiting.limit)

    @property
    def longest_work_s(self) -> float:
        """The seconds for which a worker has been at the same request."""
        with self._lock:
            now = time.monotonic()
            return now - min(self._working.values(), default=now)

    def put(self, request: RequestT, nbytes: int) -> list[RequestT]:
        """Queue a request for a worker; return those that are too many now."""
        with self._lock:
            excess = self._waiting.put(request.owner, request, nbytes)
            self._fill()
            return excess

    def send(self, request: RequestT, nbytes: int) -> bool:
        """Free the worker of a request whose reply is made and about to be sent.

        Return whether it may be: a large one may not while others take the memory. Of requests
        that are not handled any more, every reply may.
        """
        with self._lock:
            if request not in self._working:
                return True
            on_their_way = sum(self._sending.values())
            if (
                nbytes > _SMALL_REPLY_BYTES
                and on_their_way
                and on_their_way + nbytes > _REPLY_BYTES
            ):
                return False
            self._working.pop(request, None)
            self._sending[request] = nbytes
            self._fill()
            return True

    def finish(self, request: RequestT) -> None:
        """End a request: its reply is sent."""
        with self._lock:
            self._working.pop(request, None)
            self._sending.pop(request, None)
            self._fill()

    def clear(self) -> list[RequestT]:
        """Remove all requests that wait."""
        with self._lock:
            return self._waiting.clear()

    def _fill(self) -> None:
        """Start requests while there are workers and replies can be sent."""
        while len(self._working) < self._workers and len(self._sending) < MOST_SENDING:
            request = self._waiting.take(self._may_begin)
            if request is None:
                return
            self._working[request] = time.monotonic()
            self._begin(request)

    def _may_begin(self, request: RequestT) -> bool:
        owner = request.owner
        working = sum(one.owner.group == owner.group for one in self._working)
        sending = [one.owner for one in self._sending if one.owner.group == owner.group]
        return (
            working < self._most_each
            and len(sending) < MOST_SENDING // 2
            and sending.count(owner) < _SENDING_EACH
        )
