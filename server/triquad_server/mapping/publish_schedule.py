"""Decides when the next epoch of a map is due."""

import threading
import time

_MIN_PUBLISH_SHARE = 5
"""Publishing takes at most one part in this many of the thread's time."""

_SOONEST_PUBLISH_S = 0.1
"""The least time between epochs that a flush waits for, seconds: however much is flushed, an epoch
that was just queried stays for a moment."""


class PublishSchedule:
    """Schedules epochs in periods while the map changes; any thread may request one."""

    def __init__(self, period_s: float) -> None:
        """Begin with nothing to be published."""
        self._period_s = period_s
        self._asked = threading.Event()
        self._next_s = self._soonest_s = 0.0  # monotonic
        self.is_changed = False  # whether the map changed since the newest epoch

    def ask(self) -> None:
        """Let an epoch follow soon, without waiting for the whole period."""
        self._asked.set()

    def take_due(self) -> bool:
        """Return whether an epoch is due now, which the caller then publishes."""
        now = time.monotonic()
        if self._asked.is_set():
            if now < self._soonest_s:
                return False
            self._asked.clear()
            return True
        return self.is_changed and now >= self._next_s

    def published(self, took_s: float) -> None:
        """Record that an epoch was published, which took ``took_s``."""
        now = time.monotonic()
        self.is_changed = False
        self._next_s = now + max(self._period_s, _MIN_PUBLISH_SHARE * took_s)
        self._soonest_s = now + min(self._period_s, _SOONEST_PUBLISH_S)

    @property
    def left_s(self) -> float | None:
        """Return the seconds until an epoch is due; None: until something happens."""
        if self._asked.is_set():
            return max(0.0, self._soonest_s - time.monotonic())
        return max(0.0, self._next_s - time.monotonic()) if self.is_changed else None
