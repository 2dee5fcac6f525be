"""Names and times in messages of ROS."""

import re
from typing import Any

_MAX_CHARACTERS = 64  # of the name of a source


def frame_name(name: str) -> str:
    """Return a frame's name without the leading slash that ROS 1 wrote."""
    return name.lstrip("/")


def stamp_ns(header: Any) -> int:
    """Return the header's time, nanoseconds since 1970."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def source_of_topic(topic: str) -> str:
    """Return the source name of a topic's scans: ``/lidar/points`` is ``lidar.points``.

    What cannot stand in such a name becomes an underscore.
    """
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", topic.strip("/").replace("/", "."))
    return re.sub(r"^[^A-Za-z0-9]+", "", name)[:_MAX_CHARACTERS] or "default"
