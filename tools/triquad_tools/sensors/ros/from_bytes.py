"""Messages that come often or are large, read from their bytes: the library takes too long."""

import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from triquad_client.pose import Pose

from triquad_tools.sensors.motion.frame_tree import Transform
from triquad_tools.sensors.ros.header import frame_name
from triquad_tools.sensors.ros.type_store import LIVOX, TRANSFORMS, type_store
from triquad_tools.sensors.sweep import NoScanError, Sweep

_COUNT, _TIME, _POSE = struct.Struct("<I"), struct.Struct("<iI"), struct.Struct("<7d")
_LIVOX = struct.Struct("<QI4sI")  # timebase, points, number of the lidar, points again
_SAME_CLOCK_NS = 10**9
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
    """Return a message: transforms, the sweep of a Livox, or else what the ``library`` makes."""
    is_understood = is_ros_1 or payload[:2] == _ENCAPSULATION
    if kind in LIVOX:
        if not is_understood:
            raise ValueError("it is big endian")
        return _livox(payload, is_ros_1)
    return (
        _transforms(payload, is_ros_1) if kind in TRANSFORMS and is_understood else library(payload)
    )


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


def _livox(data: bytes, is_ros_1: bool) -> Sweep:
    """Return the points of a CustomMsg, whose times count from its ``timebase``."""
    start = 0 if is_ros_1 else 4
    stamp_ns, frame, at = _header(data, start, is_ros_1)
    at += 0 if is_ros_1 else -(at - start) % 8
    base_ns, _, _, count = _LIVOX.unpack_from(data, at)
    dtype = np.dtype([("t", "<u4"), ("xyz", "<f4", 3), ("more", "u1", 3 if is_ros_1 else 4)])
    table = data[at + _LIVOX.size :] + bytes(0 if is_ros_1 else 1)  # the last is not padded
    if len(table) != count * dtype.itemsize and count:
        raise ValueError(f"{len(table)} bytes are not {count} points")
    rows = np.frombuffer(table, dtype, count)
    rows = rows[np.isfinite(rows["xyz"]).all(axis=1) & rows["xyz"].any(axis=1)]  # 0: no return
    since_ns = base_ns - stamp_ns if abs(base_ns - stamp_ns) < _SAME_CLOCK_NS else 0
    offsets_s = (rows["t"] + np.float64(since_ns)) / 1e9
    note = f"point times: offset_time, {np.ptp(offsets_s) if len(rows) else 0:.1g} s"
    return Sweep(rows["xyz"].copy(), frame_name(frame), stamp_ns, offsets_s, note)


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
