"""Messages that arrived and wait for the thread that reads them: the newest, within limits."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from triquad_server.ros2.intake.feeds import Role


@dataclass(frozen=True)
class Arrival:
    """A message as it arrived."""

    role: Role
    topic_name: str
    payload: zenoh.ZBytes
    arrived_ns: int  # nanoseconds since 1970, by this machine's clock
    attachment: bytes = b""


@dataclass(frozen=True)
class LaneLimit:
    """How much may wait."""

    messages: int
    bytes: int


class _Lane:
    """Messages in the order in which they came; the oldest go where there are too many."""

    def __init__(self, limit: LaneLimit) -> None:
        self._limit = limit
        self._bytes = 0
        self.waiting: deque[Arrival] = deque()

    def put(self, arrival: Arrival) -> list[Arrival]:
        """Add a message; those that are pushed out."""
        self.waiting.append(arrival)
        self._bytes += len(arrival.payload)
        pushed_out = []
        while len(self.waiting) > self._limit.messages or self._bytes > self._limit.bytes:
            pushed_out.append(self.take())
        return pushed_out

    def take(self) -> Arrival:
        """The oldest message."""
        arrival = self.waiting.popleft()
        self._bytes -= len(arrival.payload)
        return arrival


class Inbox:
    """Two lanes: what says something about scans is read before the scans."""

    def __init__(
        self, scans: LaneLimit, others: LaneLimit, pushed_out: Callable[[Arrival], None]
    ) -> None:
        """``pushed_out`` is called with each message that nobody will read."""
        self._changed = threading.Condition()
        self._scans = _Lane(scans)
        self._others = _Lane(others)
        self._pushed_out = pushed_out
        self._closed = False

    def put(self, arrival: Arrival) -> None:
        """Add a message; never waits."""
        lane = self._scans if arrival.role.brings_scans else self._others
        with self._changed:
            gone = lane.put(arrival)
            self._changed.notify()
        for each in gone:
            self._pushed_out(each)

    def take(self, timeout_s: float) -> Arrival | None:
        """The message to read next; None where none comes in time, or it is closed."""
        with self._changed:
            self._changed.wait_for(self._is_due, timeout_s)
            for lane in (self._others, self._scans):
                if lane.waiting and not self._closed:
                    return lane.take()
            return None

    def close(self) -> None:
        """Give out no more messages."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _is_due(self) -> bool:
        return bool(self._closed or self._others.waiting or self._scans.waiting)
