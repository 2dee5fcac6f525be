"""When work in the background goes on: queries come first, and it takes turns."""

import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager


class QueryGate:
    """Counts the queries in flight, to which training and meshing give way between their steps."""

    def __init__(self) -> None:
        self._idle = threading.Condition()
        self._in_flight = 0
        self._answered_s = -math.inf  # when a query last was, monotonic
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
