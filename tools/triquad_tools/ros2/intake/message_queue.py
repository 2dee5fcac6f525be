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


class MessageQueue:
    """Scans, and other messages, which go first: transforms must not wait behind large clouds."""

    def __init__(
        self, scans: QueueLimits, others: QueueLimits, dropped: Callable[[Arrival], None]
    ) -> None:
        """``dropped`` is called with each message that nobody will read."""
        self._limits = {True: scans, False: others}  # by whether they bring scans
        self._waiting: dict[bool, deque[Arrival]] = {True: deque(), False: deque()}
        self._bytes = {True: 0, False: 0}  # of these
        self._dropped = dropped
        self._changed = threading.Condition()
        self._closed = False

    def put(self, arrival: Arrival) -> None:
        """Add a message; where they are too many, the oldest go. Never waits."""
        is_scan = arrival.role.brings_scans
        line, limits = self._waiting[is_scan], self._limits[is_scan]
        gone = []
        with self._changed:
            line.append(arrival)
            self._bytes[is_scan] += arrival.nbytes
            while len(line) > limits.messages or self._bytes[is_scan] > limits.nbytes:
                gone.append(self._oldest(is_scan))
            self._changed.notify()
        for each in gone:
            self._dropped(each)

    def take(self, timeout_s: float) -> Arrival | None:
        """Return the message to read next; None if none comes in time, or the queue is closed."""
        with self._changed:
            others, scans = self._waiting[False], self._waiting[True]
            self._changed.wait_for(lambda: self._closed or others or scans, timeout_s)
            return None if self._closed or not (others or scans) else self._oldest(not others)

    def _oldest(self, is_scan: bool) -> Arrival:
        arrival = self._waiting[is_scan].popleft()
        self._bytes[is_scan] -= arrival.nbytes
        return arrival

    def close(self) -> None:
        """Give out no more messages."""
        with self._changed:
            self._closed = True
            self._changed.notify()
