"""Pending messages for the thread that reads them: the newest, within limits."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from triquad_tools.ros2.topic_choice import Role


@dataclass(frozen=True)
class Arrival:
    """A message as it arrived."""

    role: Role
    topic_name: str
    payload: zenoh.ZBytes
    arrived_ns: int  # nanoseconds since 1970, by this machine's clock
    attachment: bytes = b""


@dataclass(frozen=True)
class WaitLimit:
    """The limits of what may be pending."""

    messages: int
    bytes: int


class _Waiting:
    """Messages in the order in which they came; the oldest are dropped where there are too many."""

    def __init__(self, limit: WaitLimit) -> None:
        self._limit = limit
        self._bytes = 0
        self.messages: deque[Arrival] = deque()

    def put(self, arrival: Arrival) -> list[Arrival]:
        """Add a message; return those that are dropped for it."""
        self.messages.append(arrival)
        self._bytes += len(arrival.payload)
        dropped = []
        while len(self.messages) > self._limit.messages or self._bytes > self._limit.bytes:
            dropped.append(self.take())
        return dropped

    def take(self) -> Arrival:
        """Return the oldest message."""
        arrival = self.messages.popleft()
        self._bytes -= len(arrival.payload)
        return arrival


class MessageQueue:
    """A queue in which messages about scans come before the scans."""

    def __init__(
        self, scans: WaitLimit, others: WaitLimit, dropped: Callable[[Arrival], None]
    ) -> None:
        """``dropped`` is called with each message that nobody will read."""
        self._changed = threading.Condition()
        self._scans = _Waiting(scans)
        self._others = _Waiting(others)
        self._dropped = dropped
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
            self._changed.wait_for(lambda: self._closed or self._first is not None, timeout_s)
            return None if self._closed or self._first is None else self._first.take()

    def close(self) -> None:
        """Give out no more messages."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    @property
    def _first(self) -> _Waiting | None:
        """Return the queue of the next message."""
        return next((each for each in (self._others, self._scans) if each.messages), None)
