"""What to tell the user while no cloud and no depth image arrives."""

import logging
from collections.abc import Iterable

from triquad_tools.sensors.ros.type_store import IMAGE, POINT_CLOUD

from triquad_server.ros2.intake.feeds import Choice
from triquad_server.ros2.topics import Topic

_log = logging.getLogger("triquad_server.ros2")

AFTER_S = 10.0
_MOST_LISTED = 20


class Silence:
    """Says so, once, where nothing came for a while, and what there is instead."""

    def __init__(self, choice: Choice, now_s: float) -> None:
        self._choice = choice
        self._say_s: float | None = now_s + AFTER_S

    def end(self, topic_name: str) -> None:
        """Something came."""
        if self._say_s is not None:
            _log.info("ros2: the first scan of %s came", topic_name)
            self._say_s = None

    def check(self, found: Iterable[Topic], now_s: float) -> None:
        """Say what there is, where it is time; ``found`` are all topics that somebody publishes."""
        if self._say_s is None or now_s < self._say_s:
            return
        self._say_s = None
        _log.warning("ros2: no cloud came in %.0f s; %s", AFTER_S, self._what_there_is(found))

    def _what_there_is(self, found: Iterable[Topic]) -> str:
        topics = sorted(found, key=lambda topic: topic.name)
        wanted = [*self._choice.clouds, *self._choice.depth]
        if not topics:
            return (
                f"nobody publishes anything in domain {self._choice.domain}: do the robot's nodes "
                "or its bridge reach this server, and is ros2.domain their ROS_DOMAIN_ID?"
            )
        usable = [each for each in topics if each.type_name in (POINT_CLOUD, IMAGE)]
        listed = ", ".join(f"{each.name} ({each.type_name})" for each in usable[:_MOST_LISTED])
        where = f" below {self._choice.prefix}" if self._choice.prefix else ""
        return (
            f"wanted are {', '.join(wanted) or f'all clouds{where}'}, and there are "
            f"{listed or 'no clouds or images'} among {len(topics)} topics: see ros2.clouds, "
            "ros2.depth and ros2.namespace"
        )
