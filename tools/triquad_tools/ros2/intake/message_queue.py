"""Pending messages for the thread that reads them: the newest, within limits."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from triquad_tools.ros2.options import Role


@dataclass(frozen=True, eq=False)
class Arrival:
    """A message as it arrived."""

    role: Role
    topic_name: str
    payload: zenoh.ZBytes
    arrived_ns: int  # nanoseconds since 1970, by this machine's clock
    attachment: bytes = b""

    @property
    def nbytes(self) -> int:
        """About the memory that it takes."""
        return len(self.payload) + 1000


@dataclass(frozen=True)
class QueueLimits:
    """The most that may wait."""

    messages: int
    nbytes: int


class _Line:
    """Messages in the order in which they came; where they are too many, the oldest go."""

    def __init__(self, limits: QueueLimits) -> None:
        self._limits = limits
        self._messages: deque[Arrival] = deque()
        self._bytes = 0  # of these

    def __len__(self) -> int:
        return len(self._messages)

    def put(self, arrival: Arrival) -> list[Arrival]:
        """Add a message; return those that go for it."""
        self._messages.append(arrival)
        self._bytes += arrival.nbytes
        gone = []
        while len(self) > self._limits.messages or self._bytes > self._limits.nbytes:
            gone.append(self.take())
        return gone

    def take(self) -> Arrival:
        """Remove the oldest message and return it."""
        arrival = self._messages.popleft()
        self._bytes -= arrival.nbytes
        return arrival


class MessageQueue:
    """Scans, and other messages, which go first: transforms must not wait behind large clouds."""

    def __init__(
        self, scans: QueueLimits, others: QueueLimits, dropped: Callable[[Arrival], None]
    ) -> None:
        """``dropped`` is called with each message that nobody will read."""
        self._scans = _Line(scans)
        self._others = _Line(others)
        self._dropped = dropped
        self._changed = threading.Condition()
        self._closed = False

    def put(self, arrival: Arrival) -> None:
        """Add a message; never waits."""
        with self._changed:
            dropped = (self._scans if arrival.role.brings_scans else self._others).put(arrival)
            self._changed.notify()
        for each in dropped:
            self._dropped(each)

    def take(self, timeout_s: float) -> Arrival | None:
        """Return the message to read next; None if none comes in time, or the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._others or self._scans, timeout_s)
            line = self._others or self._scans
            return None if self._closed or not line else line.take()

    def close(self) -> None:
        """Give out no more messages."""
        with self._changed:
            self._closed = True
            self._changed.notify()
