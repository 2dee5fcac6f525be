"""The queue of requests: client sessions take turns at a few workers."""

import threading
import time
from collections.abc import Callable

from triquad_format.wire.metrics_messages import QueueMetrics

from triquad_server.fair_queue import FairQueue
from triquad_server.serving.request import Request

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


class RequestQueue:
    """A bounded queue of requests, each handled by one of some workers; safe for any thread.

    A session has at most half of the workers, so that one is left for the next. A request occupies
    its worker until its reply is made: while that is sent, another may begin.
    """

    def __init__(
        self, begin: Callable[[Request], None], *, workers: int, requests_each: int, nbytes: int
    ) -> None:
        """Begin with no requests; ``begin`` has a thread handle a request, and returns at once.

        At most ``requests_each`` of one client session wait, and ``nbytes`` of all together.
        """
        self._begin = begin
        self._workers = workers
        self._most_each = max(1, workers // 2)
        self._lock = threading.Lock()
        self._waiting: FairQueue[Request] = FairQueue(
            requests_each * _SESSIONS_WAITING,
            nbytes,
            requests_each,
            newest_go=True,
        )
        self._working: dict[Request, float] = {}  # with the time of their begin, monotonic
        self._sending: dict[Request, int] = {}  # with the bytes of the reply

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

    def put(self, request: Request, nbytes: int) -> list[Request]:
        """Queue a request for a worker; return those that are too many now."""
        with self._lock:
            excess = self._waiting.put(request.owner, request, nbytes)
            self._fill()
            return excess

    def send(self, request: Request, nbytes: int) -> bool:
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

    def finish(self, request: Request) -> None:
        """End a request: its reply is sent."""
        with self._lock:
            self._working.pop(request, None)
            self._sending.pop(request, None)
            self._fill()

    def clear(self) -> list[Request]:
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

    def _may_begin(self, request: Request) -> bool:
        owner = request.owner
        working = sum(one.owner.group == owner.group for one in self._working)
        sending = [one.owner for one in self._sending if one.owner.group == owner.group]
        return (
            working < self._most_each
            and len(sending) < MOST_SENDING // 2
            and sending.count(owner) < _SENDING_EACH
        )
