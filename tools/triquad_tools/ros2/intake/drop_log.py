"""The log of what is received: messages of which no scan could be published, and the first scan."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable

from triquad_tools.ros2.options import TopicChoice
from triquad_tools.ros2.topics import Topic
from triquad_tools.sensors.ros.type_store import CLOUDS, IMAGES

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
    "ray_origin": "--ray-origin TOPIC=X,Y,Z says where the sensor sits in it, in metres; 0,0,0 if "
    "they do begin there, or the setting ray_origin_m of the source says it to the server; of "
    "clouds that were merged, choose those of each sensor with --clouds",
    "units": "--ray-origin TOPIC=0,0,0 if they are right",
    "not_received": "the network or the publisher drops them: publish fewer or smaller clouds, or "
    "with RELIABLE delivery",
    "pushed_out": "messages come faster than they are read: choose fewer topics with --clouds",
    "too_large": "publish smaller clouds, or with fewer fields",
    "decode": "is it another type, or was it cut off? --clouds leaves the topic out",
    "time_backwards": "messages of a topic have to come in the order of their stamps",
    "not_sent": "is the map server up, and does the role of --config let it publish?",
}

AFTER_S = 10.0
_MOST_LISTED = 20
_USABLE = (*CLOUDS, *IMAGES)


class DropLog:
    """Counts by reason; the log has the first of each topic and reason, then one line a while."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """``clock`` returns seconds."""
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._logged_s: dict[tuple[str, str], float] = {}  # by topic and reason
        self._since: Counter[tuple[str, str]] = Counter()  # dropped since it was logged

    def counts(self) -> dict[str, int]:
        """Return how many messages were dropped so far, by reason."""
        with self._lock:
            return dict(self._counts)

    def add(self, topic_name: str, reason: str, text: object, count: int = 1) -> None:
        """Count messages that are dropped, and why."""
        with self._lock:
            self._counts[reason] += count
        if since := self._due(topic_name, reason, count):
            remedy = f" ({REMEDIES[reason]})" if reason in REMEDIES else ""
            _log.warning("%s: %d dropped, %s: %s%s", topic_name, since, reason, text, remedy)

    def remark(self, topic_name: str, text: str, reason: str = "") -> None:
        """Log something that drops nothing by itself, as often as a drop of one reason.

        A text is a reason of its own, unless one is given.
        """
        if self._due(topic_name, reason or text, 1):
            _log.warning("%s: %s", topic_name, text)

    def _due(self, topic_name: str, reason: str, count: int) -> int:
        """Return how many to report in the log; 0: it is not time for that."""
        kind, now_s = (topic_name, reason), self._clock()
        with self._lock:
            if kind not in self._logged_s and len(self._logged_s) >= _MAX_REMEMBERED:
                return 0
            self._since[kind] += count
            if now_s - self._logged_s.get(kind, -LOG_PERIOD_S) < LOG_PERIOD_S:
                return 0
            self._logged_s[kind] = now_s
            return self._since.pop(kind)


class FirstScan:
    """Logs the first scan or, once, if none came for a while, what there is instead."""

    def __init__(self, choice: TopicChoice, now_s: float) -> None:
        self._choice = choice
        self._due_s: float | None = now_s + AFTER_S

    def came(self, topic_name: str) -> None:
        """Record that a scan came."""
        if self._due_s is not None:
            _log.info("the first scan of %s came", topic_name)
            self._due_s = None

    def check(self, found: Iterable[Topic], now_s: float) -> None:
        """Log what there is, once it is time; ``found`` are all published topics."""
        if self._due_s is None or now_s < self._due_s:
            return
        self._due_s = None
        choice, topics = self._choice, list(found)
        usable = sorted(f"{t.name} ({t.type_name})" for t in topics if t.type_name in _USABLE)
        wanted = ", ".join((*choice.clouds, *choice.depth)) or f"all clouds below {choice.prefix}/"
        what = (
            f"wanted are {wanted}, and there are "
            f"{', '.join(usable[:_MOST_LISTED]) or 'no clouds or images'} among {len(topics)} "
            "topics: see --clouds, --depth and --namespace"
        )
        if not topics:
            what = (
                f"nobody publishes anything in domain {choice.domain}: do the robot's nodes or its "
                "zenoh-bridge-ros2dds use the same router, and is --domain their ROS_DOMAIN_ID?"
            )
        _log.warning("no cloud came in %.0f s; %s", AFTER_S, what)
