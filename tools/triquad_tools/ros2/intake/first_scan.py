"""Logging the first scan, or what prevents it while none comes."""

import logging
from collections.abc import Iterable

from triquad_tools.ros2.topic_choice import TopicChoice
from triquad_tools.ros2.topics import Topic
from triquad_tools.sensors.ros.type_store import IMAGE, POINT_CLOUD

_log = logging.getLogger("triquad_ros2")

AFTER_S = 10.0
_MOST_LISTED = 20
_USABLE = (POINT_CLOUD, IMAGE)


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
