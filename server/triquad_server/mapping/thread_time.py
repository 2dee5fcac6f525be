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


class ThreadTime:
    """How a thread spends its time: that thread tells, any may ask."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Idle at first; ``clock`` gives seconds that never run backwards."""
        self._clock = clock
        self._lock = threading.Lock()
        self._spent_s = dict.fromkeys(Activity, 0.0)
        self._activity, self._since_s = Activity.IDLE, clock()

    def begin(self, activity: Activity) -> None:
        """The thread turns to another activity, or begins the same anew."""
        now = self._clock()
        with self._lock:
            self._spent_s[self._activity] += now - self._since_s
            self._activity, self._since_s = activity, now

    def current(self) -> Current:
        """What the thread does now, and for how long it has."""
        with self._lock:
            return Current(self._activity, self._clock() - self._since_s)

    def spent_s(self) -> dict[str, float]:
        """Seconds so far, by activity, with what goes on now."""
        with self._lock:
            spent_s = dict(self._spent_s)
            spent_s[self._activity] += self._clock() - self._since_s
        return {activity.value: seconds for activity, seconds in spent_s.items()}
