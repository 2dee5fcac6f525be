"""What a thread spends its time on."""

import threading
import time
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple


class Activity(Enum):
    """What the mapper's thread does."""

    SCANS = "scans"  # taking them in
    TRAINING = "training"
    GIVING_WAY = "giving_way"  # to queries that are being answered
    PUBLISHING = "publishing"
    COMMANDS = "commands"  # such as what a checkpoint needs
    IDLE = "idle"


class Current(NamedTuple):
    """What a thread does now."""

    activity: Activity
    for_s: float
    waited_s: float  # of that, in which it did not compute


class ThreadTime:
    """How a thread spends its time: that thread tells, any may ask."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Idle at first; ``clock`` gives seconds that never run backwards."""
        self._clock = clock
        self._lock = threading.Lock()
        self._spent_s = dict.fromkeys(Activity, 0.0)
        self._activity, self._since_s = Activity.IDLE, clock()
        self._cpu_clock: int | None = None  # that of the thread, once it has told anything
        self._computed_s = 0.0  # by the thread, until its activity began

    def begin(self, activity: Activity) -> None:
        """The thread turns to another activity, or begins the same again."""
        now, computed_s = self._clock(), time.thread_time()
        with self._lock:
            if self._cpu_clock is None:
                self._cpu_clock = time.pthread_getcpuclockid(threading.get_ident())
            self._spent_s[self._activity] += now - self._since_s
            self._activity, self._since_s, self._computed_s = activity, now, computed_s

    def current(self) -> Current:
        """What the thread does now, and for how long it has."""
        with self._lock:
            for_s = self._clock() - self._since_s
            waited_s = max(0.0, for_s - self._computed_since_s())
            return Current(self._activity, for_s, waited_s)

    def spent_s(self) -> dict[str, float]:
        """Seconds so far, by activity, with what goes on now."""
        with self._lock:
            spent_s = dict(self._spent_s)
            spent_s[self._activity] += self._clock() - self._since_s
        return {activity.value: seconds for activity, seconds in spent_s.items()}

    def _computed_since_s(self) -> float:
        """For how long the thread has computed since its activity began."""
        if self._cpu_clock is None:
            return 0.0
        try:
            return time.clock_gettime(self._cpu_clock) - self._computed_s
        except OSError:  # the thread has ended
            return 0.0
