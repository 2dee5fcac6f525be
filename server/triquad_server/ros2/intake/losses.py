"""Messages that came to nothing: counted, and said in the log, but not each of them."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from triquad_server.counter import Counter

_log = logging.getLogger("triquad_server.ros2")

LOG_PERIOD_S = 10.0
_MAX_REMEMBERED = 1000

REMEDIES = {
    "no_transform": "is /tf published, and in the same ros2.domain and ros2.namespace? "
    "ros2.map_frame names the frame to map in, ros2.poses another source of poses",
    "pose_late": "transforms come too late: raise ros2.waiting_s, or, where the clocks of sensor "
    'and poses differ, set ros2.clock = "arrival"',
    "pose_early": 'some at the start are usual; else the clocks differ: set ros2.clock = "arrival"',
    "pose_gap": "poses came too seldom or not at all for a while",
    "not_received": "the network or the publisher drops them: publish fewer or smaller clouds, or "
    "with RELIABLE delivery",
    "pushed_out": "clouds come faster than they are read: choose fewer topics with ros2.clouds",
    "too_large": "raise scan.max_points",
    "decode": "is it another type, or was it cut off? The topic is left out with ros2.clouds",
}


@dataclass
class _Kind:
    """One reason for which messages of one topic are lost."""

    logged_s: float
    since: int = 0  # lost since it was logged


class Losses:
    """Counts by reason; the log has the first of each topic and reason, then one line a while."""

    def __init__(self, counter: Counter, clock: Callable[[], float] = time.monotonic) -> None:
        """Counts go into ``counter``; ``clock`` tells seconds."""
        self._counter = counter
        self._clock = clock
        self._kinds: dict[tuple[str, str], _Kind] = {}

    def add(self, topic_name: str, reason: str, text: object, count: int = 1) -> None:
        """Count messages that are lost, and why."""
        self._counter.add(reason, count)
        self.say(topic_name, reason, text, count)

    def say(self, topic_name: str, reason: str, text: object, count: int = 1) -> None:
        """As :meth:`add`, for what is counted elsewhere."""
        since = self._due(topic_name, reason, count)
        if since is not None:
            remedy = f" ({REMEDIES[reason]})" if reason in REMEDIES else ""
            _log.warning("ros2: %s: %d lost, %s: %s%s", topic_name, since, reason, text, remedy)

    def remark(self, topic_name: str, text: str) -> None:
        """As :meth:`say`, for what loses nothing by itself; the same text is one reason."""
        if self._due(topic_name, text, 1) is not None:
            _log.warning("ros2: %s: %s", topic_name, text)

    def _due(self, topic_name: str, reason: str, count: int) -> int | None:
        """How many to tell of in the log, where it is time for that."""
        now_s = self._clock()
        kind = self._kinds.get((topic_name, reason))
        if kind is None:
            if len(self._kinds) >= _MAX_REMEMBERED:
                return None
            kind = self._kinds[topic_name, reason] = _Kind(now_s - LOG_PERIOD_S)
        kind.since += count
        if now_s - kind.logged_s < LOG_PERIOD_S:
            return None
        since, kind.logged_s, kind.since = kind.since, now_s, 0
        return since
