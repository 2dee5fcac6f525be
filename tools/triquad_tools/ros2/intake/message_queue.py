"""Pending messages for the thread that reads them: the newest, within limits."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from triquad_tools.ros2.topic_choice import Role


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


class MessageQueue:
    """Messages in the order in which they came; where they are too many, the oldest scan goes."""

    def __init__(self, scans: int, max_bytes: int, dropped: Callable[[Arrival], None]) -> None:
        """``dropped`` is called with each message that nobody will read."""
        self._max_scans = scans
        self._max_bytes = max_bytes
        self._dropped = dropped
        self._changed = threading.Condition()
        self._messages: deque[Arrival] = deque()
        self._scans = self._bytes = 0  # of these
        self._closed = False

    def put(self, arrival: Arrival) -> None:
        """Add a message; never waits."""
        dropped = []
        with self._changed:
            self._messages.append(arrival)
            self._count(arrival, 1)
            while self._scans > self._max_scans or self._bytes > self._max_bytes:
                scans = (each for each in self._messages if each.role.brings_scans)
                oldest = next(scans, self._messages[0])
                self._messages.remove(oldest)
                self._count(oldest, -1)
                dropped.append(oldest)
            self._changed.notify()
        for each in dropped:
            self._dropped(each)

    def take(self, timeout_s: float) -> Arrival | None:
        """Return the message to read next; None if none comes in time, or the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._messages, timeout_s)
            if self._closed or not self._messages:
                return None
            arrival = self._messages.popleft()
            self._count(arrival, -1)
            return arrival

    def close(self) -> None:
        """Give out no more messages."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _count(self, arrival: Arrival, sign: int) -> None:
        self._scans += sign * arrival.role.brings_scans
        self._bytes += sign * arrival.nbytes
