"""The header of every stamped message of ROS."""

from typing import Any


def frame_name(name: str) -> str:
    """Return a frame's name without the leading slash that ROS 1 wrote."""
    return name.lstrip("/")


def stamp_ns(header: Any) -> int:
    """Return the header's time, nanoseconds since 1970."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
