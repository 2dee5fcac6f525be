"""Messages of which no scan could be published: all are counted, and some logged."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

_log = logging.getLogger("triquad_ros2")

LOG_PERIOD_S = 10.0
_MAX_REMEMBERED = 1000

REMEDIES = {
    "no_transform": "is /tf published, and in the same --domain and --namespace? --map-frame names "
    "the frame to map in, --poses another source of poses",
    "pose_late": "transforms come too late: raise --wait-s, or, where the clocks of sensor and "
    "poses differ, use --clock arrival",
    "pose_early": "some at the start are usual; else the clocks differ: use --clock arrival",
    "pose_gap": "poses came too seldom or not at all for a while",
    "not_received": "the network or the publisher drops them: publish fewer or smaller clouds, or "
    "with RELIABLE delivery",
    "pushed_out": "clouds come faster than they are read: choose fewer topics with --clouds",
    "too_large": "publish smaller clouds, or with fewer fields",
    "decode": "is it another type, or was it cut off? --clouds leaves the topic out",
    "time_backwards": "messages of a topic have to come in the order of their stamps",
    "not_sent": "is the map server up, and does the role of --config let it publish?",
}


@dataclass
class _Kind:
    """One reason for which messages of one topic are dropped."""

    logged_s: float
    since: int = 0  # dropped since it was logged


class DropLog:
    """Counts by reason; the log has the first of each topic and reason, then one line a while."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """``clock`` returns seconds."""
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._kinds: dict[tuple[str, str], _Kind] = {}

    def counts(self) -> dict[str, int]:
        """Return how many messages were dropped so far, by reason."""
        with self._lock:
            return dict(self._counts)

    def add(self, topic_name: str, reason: str, text: object, count: int = 1) -> None:
        """Count messages that are dropped, and why."""
        with self._lock:
            self._counts[reason] += count
            since = self._due(topic_name, reason, count)
        if since is not None:
            remedy = f" ({REMEDIES[reason]})" if reason in REMEDIES else ""
            _log.warning("%s: %d dropped, %s: %s%s", topic_name, since, reason, text, remedy)

    def remark(self, topic_name: str, text: str) -> None:
        """Log something that drops nothing by itself, as often as a drop; a text is one reason."""
        with self._lock:
            since = self._due(topic_name, text, 1)
        if since is not None:
            _log.warning("%s: %s", topic_name, text)

    def _due(self, topic_name: str, reason: str, count: int) -> int | None:
        """Return how many to report in the log, if it is time for that."""
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
