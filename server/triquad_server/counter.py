"""Counts events by reason; safe for any thread."""

import threading


class Counter:
    """Counts how often each thing happened."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: dict[str, int] = {}

    def add(self, reason: str, count: int = 1) -> None:
        """Count ``reason``; reasons are words of the program, never of a message."""
        with self._lock:
            self._counts[reason] = self._counts.get(reason, 0) + count

    def counts(self) -> dict[str, int]:
        """Return the counts so far."""
        with self._lock:
            return dict(self._counts)
