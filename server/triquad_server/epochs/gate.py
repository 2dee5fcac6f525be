"""Lets training give way to queries."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class QueryGate:
    """Counts the queries in flight; training waits a moment between slices while there are any."""

    def __init__(self) -> None:
        self._idle = threading.Condition()
        self._in_flight = 0

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
                if self._in_flight == 0:
                    self._idle.notify_all()

    def give_way(self, limit_s: float) -> None:
        """Return once no query is in flight, or after ``limit_s``: training never starves."""
        with self._idle:
            self._idle.wait_for(lambda: self._in_flight == 0, limit_s)
