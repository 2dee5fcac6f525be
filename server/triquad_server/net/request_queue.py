"""Requests that wait and requests that are worked at: those who ask take turns."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from triquad_format.wire.metrics_messages import QueueMetrics

from triquad_server.fair_queue import FairQueue, Owner

MOST_SHORT = 8
"""Requests that are worked at in turn and may be short: the arrays of each take memory."""

MOST_LONG = 4
"""Requests, beside these, that turned out to be long: more begin anew later."""

MOST_SENDING = 32
"""Replies that are on their way, to clients that may not read them."""

_SENDING_EACH = 2
"""Replies on their way to one client, which is answered no more until it takes one."""

_MOST_OVERTAKING = 4
"""Requests that may begin before one that paused goes on."""

RequestT = TypeVar("RequestT")
CountedT = TypeVar("CountedT")


class SetAsideError(Exception):
    """A request is long, and so many are worked at already: it begins anew when one has ended."""


@dataclass(eq=False)
class Job(Generic[RequestT]):
    """A request on its way through the queue."""

    request: RequestT
    owner: Owner
    nbytes: int
    is_long: bool = False
    may_go_on: threading.Event = field(default_factory=threading.Event)  # after a pause
    is_worked_at: bool = False


@dataclass(frozen=True)
class Placed(Generic[RequestT]):
    """What putting a request into the queue led to."""

    begun: Job[RequestT] | None  # the caller is to work at it; maybe that of somebody else
    excess: list[RequestT]  # too many now; maybe the new one is among them


class RequestQueue(Generic[RequestT]):
    """A bounded queue of requests, of which some are worked at, at the same time.

    Whoever works at one for long pauses now and then, for others. It is worked at until its reply
    is made: while that is on its way, another request may begin.
    """

    def __init__(
        self,
        begin: Callable[[Job[RequestT]], None],
        are_several: Callable[[], bool],
        *,
        workers: int,
        limit: int,
        limit_bytes: int,
    ) -> None:
        """``begin`` has a thread begin with a request, and returns at once.

        As many are worked at as there are ``workers``, but while several ask (``are_several``) one
        of each group. At most ``limit`` wait, of ``limit_bytes`` together. Long ones have places of
        their own, so that one that is short begins however many of them there are.
        """
        self._begin = begin
        self._are_several = are_several
        self._workers = self._free = workers
        self._most_short = max(MOST_SHORT, workers)
        self._lock = threading.Lock()
        self._waiting: FairQueue[Job[RequestT]] = FairQueue(limit, limit_bytes)
        self._paused: deque[Job[RequestT]] = deque()
        self._overtaking = 0  # requests that began since one of the paused went on
        self._begun: Counter[str] = Counter()  # worked at or paused, by group
        self._long: set[Job[RequestT]] = set()  # of these
        self._sending: Counter[Owner] = Counter()

    @property
    def metrics(self) -> QueueMetrics:
        """What waits for a worker."""
        with self._lock:
            return QueueMetrics(len(self._waiting), self._waiting.limit)

    def put(self, owner: Owner, request: RequestT, nbytes: int) -> Placed[RequestT]:
        """Have a request wait, or the caller begin with one."""
        with self._lock:
            self._waiting.put(owner, Job(request, owner, nbytes), nbytes)
            begun = self._take_next()
            self._fill()
            return Placed(begun, [job.request for job in self._waiting.excess(newest=True)])

    def pause(self, job: Job[RequestT]) -> None:
        """Return when it is the turn of a request again that is worked at: at once, mostly."""
        with self._lock:
            other = self._next()
            if other is None:
                return
            if not self._paused:
                self._overtaking = 0
            job.may_go_on.clear()
            self._paused.append(job)
            if self._is_begun(other):
                self._begin(other)
        job.may_go_on.wait()

    def rest(self, job: Job[RequestT], rest_s: float) -> None:
        """As :meth:`pause`, after a time in which others may be worked at.

        Raises:
            SetAsideError: too many rest by turns; the request is to be :meth:`put_back`.
        """
        with self._lock:
            if job not in self._long and len(self._long) >= MOST_LONG:
                raise SetAsideError
            self._long.add(job)
            self._free += 1
            self._fill()
        time.sleep(rest_s)
        with self._lock:
            job.may_go_on.clear()
            self._paused.append(job)
            self._fill()
        job.may_go_on.wait()

    def put_back(self, job: Job[RequestT]) -> None:
        """Have a request begin anew, before others of its owner, once it may be worked at."""
        again = Job(job.request, job.owner, job.nbytes, is_long=True)
        with self._lock:
            self._waiting.put_first(job.owner, again, job.nbytes)

    def send(self, job: Job[RequestT]) -> None:
        """The reply of a request is made: it is on its way from now on. Twice does no harm."""
        with self._lock:
            if not job.is_worked_at:
                return
            job.is_worked_at = False
            self._long.discard(job)
            _count(self._begun, job.owner.group, -1)
            _count(self._sending, job.owner, 1)
            self._free += 1
            self._fill()

    def finish(self, job: Job[RequestT]) -> None:
        """The reply of a request is sent, or somebody else will see to it."""
        self.send(job)
        with self._lock:
            _count(self._sending, job.owner, -1)
            self._fill()

    def clear(self) -> list[RequestT]:
        """Have none wait any more; those that did."""
        with self._lock:
            return [job.request for job in self._waiting.clear()]

    def _fill(self) -> None:
        """Have requests worked at while there is a worker for one."""
        while (job := self._take_next()) is not None:
            self._begin(job)

    def _take_next(self) -> Job[RequestT] | None:
        """A request that somebody is to begin with, if there is a worker for one.

        Those that paused, and whose turn comes before, go on.
        """
        while self._free > 0 and (job := self._next()) is not None:
            self._free -= 1
            if self._is_begun(job):
                return job
        return None

    def _next(self) -> Job[RequestT] | None:
        """Whose turn it is."""
        if not self._paused or self._overtaking < _MOST_OVERTAKING:
            job = self._waiting.take(self._may_begin)
            if job is not None:
                self._overtaking += 1
                return job
        self._overtaking = 0
        return self._paused.popleft() if self._paused else None

    def _may_begin(self, job: Job[RequestT]) -> bool:
        group = job.owner.group
        most = 1 if self._are_several() else self._workers
        short = self._begun.total() - len(self._long)
        is_room = len(self._long) < MOST_LONG if job.is_long else short < self._most_short
        sending = sum(count for owner, count in self._sending.items() if owner.group == group)
        return (
            is_room
            and self._begun[group] < most
            and self._sending[job.owner] < _SENDING_EACH
            and sending < MOST_SENDING // 2
            and self._sending.total() < MOST_SENDING
        )

    def _is_begun(self, job: Job[RequestT]) -> bool:
        """Have a request worked at; whether it begins, and needs a thread, or it had paused."""
        if job.is_worked_at:
            job.may_go_on.set()
            return False
        job.is_worked_at = True
        if job.is_long:
            self._long.add(job)
        _count(self._begun, job.owner.group, 1)
        return True


def _count(counter: Counter[CountedT], counted: CountedT, change: int) -> None:
    """Change a count; nothing is kept of what counts 0."""
    counter[counted] += change
    if counter[counted] == 0:
        del counter[counted]
