"""Messages that come often or are large, read from their bytes: the library takes too long."""

import struct
from collections.abc import Callable
from functools import partial
from typing import Any

from rosbags.serde import SerdeError
from triquad_client.pose import Pose

from triquad_tools.sensors.motion.frame_tree import Transform
from triquad_tools.sensors.ros.header import frame_name
from triquad_tools.sensors.ros.type_store import TRANSFORMS, type_store
from triquad_tools.sensors.sweep import NoScanError

_COUNT, _TIME, _POSE = struct.Struct("<I"), struct.Struct("<iI"), struct.Struct("<7d")
_ENCAPSULATION = b"\x00\x01"  # of CDR, little endian


def decode_cdr(payload: bytes, kind: str) -> Any:
    """Return the message of its bytes, as ROS 2 sends them.

    Raises:
        NoScanError: they are no such message.
    """
    try:
        return decode(payload, kind, partial(type_store().deserialize_cdr, typename=kind))
    # Any error of the decoder: bytes of another type lead it anywhere.
    except (SerdeError, ValueError, IndexError, MemoryError, TypeError, struct.error) as error:
        raise NoScanError("decode", f"no {kind}: {error}") from error


def decode(
    payload: bytes, kind: str, library: Callable[[bytes], Any], *, is_ros_1: bool = False
) -> Any:
    """Return a message: a list of transforms, or else what the ``library`` makes of it."""
    if kind in TRANSFORMS and (is_ros_1 or payload[:2] == _ENCAPSULATION):
        return _transforms(payload, is_ros_1)
    return library(payload)


def _transforms(data: bytes, is_ros_1: bool) -> list[Transform]:
    start = 0 if is_ros_1 else 4
    (count,) = _COUNT.unpack_from(data, start)
    at, found = start + 4, []
    for _ in range(count):
        stamp_ns, parent, at = _header(data, at, is_ros_1)
        child, at = _text(data, at, is_ros_1)
        at += 0 if is_ros_1 else -(at - start) % 8
        numbers = _POSE.unpack_from(data, at)
        at += _POSE.size
        pose = Pose(numbers[:3], numbers[3:])
        found.append(Transform(frame_name(parent), frame_name(child), stamp_ns, pose))
    if at != len(data):
        raise ValueError(f"{len(data)} bytes, not {at}")
    return found


def _header(data: bytes, at: int, is_ros_1: bool) -> tuple[int, str, int]:
    """Return the stamp and the frame of a header, and where it ends."""
    at += 4 if is_ros_1 else 0  # a running number
    seconds, nanoseconds = _TIME.unpack_from(data, at)
    frame, at = _text(data, at + _TIME.size, is_ros_1)
    return seconds * 1_000_000_000 + nanoseconds, frame, at


def _text(data: bytes, at: int, is_ros_1: bool) -> tuple[str, int]:
    at += 0 if is_ros_1 else -at % 4
    (size,) = _COUNT.unpack_from(data, at)
    end = at + 4 + size
    return data[at + 4 : end if is_ros_1 else end - 1].decode(), end
