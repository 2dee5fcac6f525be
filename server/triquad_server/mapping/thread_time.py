"""Measures how a thread spends its time."""

import threading
import time
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple


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
