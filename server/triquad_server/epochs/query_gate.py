"""When work in the background goes on: queries come first, unless scans would be lost for them."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_PERIOD_S = 0.05
"""Where queries are held back, they wait in the first part of each such period, and those that have
come are answered in the rest."""

_MOST_HELD = 0.9


class QueryGate:
    """Counts the queries in flight, to which training and meshing give way between their steps."""

    def __init__(self) -> None:
        self._idle = threading.Condition()
        self._in_flight = 0
        self._answered_s = -math.inf  # when a query last was, monotonic
        self._pressure: Callable[[], float] = lambda: 0.0
        self._turns = threading.Condition()
        self._waiting: deque[object] = deque()  # whose turn it is, then who comes next

    @contextmanager
    def query(self) -> Iterator[None]:
        """A query is being answered."""
        with self._idle:
            self._in_flight += 1
        try:
            yield
        finally:
            with self._idle:
                self._in_flight -= 1
                self._answered_s = time.monotonic()
                if self._in_flight == 0:
                    self._idle.notify_all()

    def asked_within(self, seconds: float) -> bool:
        """Whether a query is in flight, or was so short a time ago."""
        with self._idle:
            return self._in_flight > 0 or time.monotonic() - self._answered_s < seconds

    def give_way(self, limit_s: float) -> None:
        """Return once no query is in flight, or after ``limit_s``: training never starves."""
        with self._idle:
            self._idle.wait_for(lambda: self._in_flight == 0, limit_s)

    def hold_back_by(self, pressure: Callable[[], float]) -> None:
        """Hold queries back for the share of the time that ``pressure`` tells, or nearly all."""
        self._pressure = pressure

    def wait_for_mapping(self) -> None:
        """Within a query: return once it may go on, which is at once but where it is held back.

        It is so once: on busy cores a query may wake up when queries are held back again already,
        and time after time.
        """
        with self._idle:
            held_s = self._held_s()
            if not held_s:
                return
            self._in_flight -= 1  # meanwhile nobody gives way to it
            self._idle.notify_all()
            until_s = time.monotonic() + held_s
            while (left_s := until_s - time.monotonic()) > 0:
                self._idle.wait(left_s)
            self._in_flight += 1

    def _held_s(self) -> float:
        held_s = min(self._pressure(), _MOST_HELD) * _PERIOD_S
        return max(0.0, held_s - time.monotonic() % _PERIOD_S)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """A step of work in the background: one after the other, in the order in which they came.

        Training and meshing at once would leave no core to a query.
        """
        mine = object()
        with self._turns:
            self._waiting.append(mine)
            self._turns.wait_for(lambda: self._waiting[0] is mine)
        try:
            yield
        finally:
            with self._turns:
                self._waiting.popleft()
                self._turns.notify_all()
