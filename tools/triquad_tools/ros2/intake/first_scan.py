"""Logging the first scan, or what prevents it while none comes."""

import logging
from collections.abc import Iterable

from triquad_tools.ros2.topic_choice import TopicChoice
from triquad_tools.ros2.topics import Topic
from triquad_tools.sensors.ros.type_store import IMAGE, POINT_CLOUD

_log = logging.getLogger("triquad_ros2")

AFTER_S = 10.0
_MOST_LISTED = 20


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
        if self._due_s is not None and now_s >= self._due_s:
            self._due_s = None
            _log.warning("no cloud came in %.0f s; %s", AFTER_S, self._what_there_is(found))

    def _what_there_is(self, found: Iterable[Topic]) -> str:
        choice, topics = self._choice, sorted(found, key=lambda topic: topic.name)
        if not topics:
            return (
                f"nobody publishes anything in domain {choice.domain}: do the robot's nodes or its "
                "zenoh-bridge-ros2dds use the same router, and is --domain their ROS_DOMAIN_ID?"
            )
        usable = [each for each in topics if each.type_name in (POINT_CLOUD, IMAGE)]
        listed = ", ".join(f"{each.name} ({each.type_name})" for each in usable[:_MOST_LISTED])
        below = f" below {choice.prefix}" if choice.prefix else ""
        wanted = ", ".join((*choice.clouds, *choice.depth)) or f"all clouds{below}"
        return (
            f"wanted are {wanted}, and there are {listed or 'no clouds or images'} among "
            f"{len(topics)} topics: see --clouds, --depth and --namespace"
        )
