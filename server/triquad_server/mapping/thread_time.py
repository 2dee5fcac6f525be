"""The time of the mapper's thread: how it is spent, and when the next epoch is due."""

import threading
import time
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

_MIN_PUBLISH_SHARE = 5
"""Publishing takes at most one part in this many of the thread's time."""

_SOONEST_PUBLISH_S = 0.1
"""The least time between epochs that a flush waits for, seconds: however much is flushed, an epoch
that was just queried stays for a moment."""


class Activity(Enum):
    """An activity of the mapper's thread."""

    SCANS = "scans"  # taking them in
    TRAINING = "training"
    GIVING_WAY = "giving_way"  # to queries that are being answered
    PUBLISHING = "publishing"
    COMMANDS = "commands"  # such as what a checkpoint needs
    IDLE = "idle"


class Current(NamedTuple):
    """The present activity of a thread."""

    activity: Activity
    for_s: float
    waited_s: float  # of that, in which it did not compute


class ThreadTime:
    """Measures how a thread spends its time; that thread reports, any may query."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin idle; ``clock`` gives seconds that never run backwards."""
        self._clock = clock
        self._lock = threading.Lock()
        self._spent_s = dict.fromkeys(Activity, 0.0)
        self._activity, self._since_s = Activity.IDLE, clock()
        self._cpu_clock: int | None = None  # that of the thread, once it has reported anything
        self._computed_s = 0.0  # CPU time of the thread until its activity began

    def begin(self, activity: Activity) -> None:
        """Record that the thread begins another activity, or the same again."""
        now, computed_s = self._clock(), time.thread_time()
        with self._lock:
            if self._cpu_clock is None:
                self._cpu_clock = time.pthread_getcpuclockid(threading.get_ident())
            self._spent_s[self._activity] += now - self._since_s
            self._activity, self._since_s, self._computed_s = activity, now, computed_s

    def current(self) -> Current:
        """Return what the thread does now, and for how long it has."""
        with self._lock:
            for_s = self._clock() - self._since_s
            waited_s = max(0.0, for_s - self._computed_since_s())
            return Current(self._activity, for_s, waited_s)

    def spent_s(self) -> dict[str, float]:
        """Return the seconds so far, by activity, with the present one."""
        with self._lock:
            spent_s = dict(self._spent_s)
            spent_s[self._activity] += self._clock() - self._since_s
        return {activity.value: seconds for activity, seconds in spent_s.items()}

    def _computed_since_s(self) -> float:
        """Return for how long the thread has computed since its activity began."""
        if self._cpu_clock is None:
            return 0.0
        try:
            return time.clock_gettime(self._cpu_clock) - self._computed_s
        except OSError:  # the thread has ended
            return 0.0


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
