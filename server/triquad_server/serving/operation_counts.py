"""Counts the results of each operation's requests, and their times."""

import threading
import time
from bisect import bisect_left

import numpy as np
from triquad_format.wire.metrics_messages import OperationMetrics, TimeHistogram

BOUNDS_S = tuple(
    round(step * 10.0**power, 6) for power in range(-4, 2) for step in (1, 1.8, 3.2, 5.6)
)
"""The upper bounds of the buckets: four a decade, 0.1 ms to 56 s."""


class Times:
    """A histogram of times; not safe for several threads at once."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def add(self, time_s: float) -> None:
        """Count something that took ``time_s`` seconds."""
        self._counts[bisect_left(BOUNDS_S, time_s)] += 1
        self._sum_s += time_s

    def histogram(self) -> TimeHistogram:
        """Return the counts so far."""
        return TimeHistogram(np.array(self._counts, np.int64), self._sum_s)


class OperationCounts:
    """Counts the requests of one operation; safe for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._answers, self._waits = Times(), Times()
        self._refused: dict[str, int] = {}
        self._pending = 0
        self._received_bytes = self._sent_bytes = 0

    def arrive(self, size: int) -> float:
        """Record a request of ``size`` bytes that arrived; return the time, monotonic seconds."""
        with self._lock:
            self._pending += 1
            self._received_bytes += size
        return time.monotonic()

    def begin(self, arrived_s: float) -> None:
        """Record that a worker begins with a request."""
        waited_s = time.monotonic() - arrived_s
        with self._lock:
            self._waits.add(waited_s)

    def answer(self, arrived_s: float, size: int) -> None:
        """Record that a request was answered with ``size`` bytes."""
        took_s = time.monotonic() - arrived_s
        with self._lock:
            self._pending -= 1
            self._sent_bytes += size
            self._answers.add(took_s)

    def refuse(self, code: str) -> None:
        """Record that a request was refused; ``code`` is one of ``ERROR_CODES``."""
        with self._lock:
            self._pending -= 1
            self._refused[code] = self._refused.get(code, 0) + 1

    def refused(self) -> dict[str, int]:
        """Return the number of refused requests, by error code."""
        with self._lock:
            return dict(self._refused)

    def metrics(self) -> OperationMetrics:
        """Return the counts so far."""
        with self._lock:
            return OperationMetrics(
                answers=self._answers.histogram(),
                waits=self._waits.histogram(),
                refused=dict(self._refused),
                pending=self._pending,
                received_bytes=self._received_bytes,
                sent_bytes=self._sent_bytes,
            )
