"""When the next epoch of a map is due."""

import threading
import time

_MIN_PUBLISH_SHARE = 5
"""Publishing takes at most one part in so many of the thread's time."""

_SOONEST_PUBLISH_S = 0.1
"""An epoch that a flush waits for comes so long after the one before, at the earliest: however much
is flushed, an epoch that was just asked stays for a moment."""


class PublishSchedule:
    """Epochs follow each other in periods while the map changes; any thread may ask for one."""

    def __init__(self, period_s: float) -> None:
        """Nothing is to be published yet."""
        self._period_s = period_s
        self._asked = threading.Event()
        self._next_s = self._soonest_s = 0.0  # monotonic
        self.is_changed = False  # the map, since the newest epoch

    def ask(self) -> None:
        """Have an epoch follow soon, without waiting for the whole period."""
        self._asked.set()

    def take_due(self) -> bool:
        """Whether an epoch is due now; who asks publishes it."""
        now = time.monotonic()
        if self._asked.is_set():
            if now < self._soonest_s:
                return False
            self._asked.clear()
            return True
        return self.is_changed and now >= self._next_s

    def published(self, took_s: float) -> None:
        """An epoch was published, which took so long."""
        now = time.monotonic()
        self.is_changed = False
        self._next_s = now + max(self._period_s, _MIN_PUBLISH_SHARE * took_s)
        self._soonest_s = now + min(self._period_s, _SOONEST_PUBLISH_S)

    @property
    def left_s(self) -> float | None:
        """How long until an epoch is due; None: until something happens."""
        if self._asked.is_set():
            return max(0.0, self._soonest_s - time.monotonic())
        return max(0.0, self._next_s - time.monotonic()) if self.is_changed else None
