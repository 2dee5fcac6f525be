"""Messages read from their bytes; clouds of a Livox, for which the library takes too long, here."""

import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rosbags.serde import SerdeError

from triquad_tools.sensors.ros.type_store import LIVOX, frame_name, type_store
from triquad_tools.sensors.sweep import NoScanError, Sweep

_HEADER = struct.Struct("<iII")  # seconds, nanoseconds, bytes of the name of the frame
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
    """Return a message: the sweep of a Livox, or else what the ``library`` makes of it."""
    if kind not in LIVOX:
        return library(payload)
    if not is_ros_1 and payload[:2] != _ENCAPSULATION:
        raise ValueError("it is big endian")
    return _livox(payload, is_ros_1)


def _livox(data: bytes, is_ros_1: bool) -> Sweep:
    """Return the points of a CustomMsg, whose times count from its ``timebase``."""
    # Behind a running number, or the encapsulation.
    seconds, nanoseconds, size = _HEADER.unpack_from(data, 4)
    at = 4 + _HEADER.size + size
    frame = data[4 + _HEADER.size : at].rstrip(b"\x00").decode()
    stamp_ns = seconds * 1_000_000_000 + nanoseconds
    at += 0 if is_ros_1 else -(at - 4) % 8
    base_ns, _, _, count = _LIVOX.unpack_from(data, at)
    dtype = np.dtype([("t", "<u4"), ("xyz", "<f4", 3), ("more", "u1", 3 if is_ros_1 else 4)])
    table = data[at + _LIVOX.size :]
    if count and not is_ros_1:
        table += bytes(1)  # the last is not padded
    if len(table) != count * dtype.itemsize:
        raise ValueError(f"{len(table)} bytes are not {count} points")
    rows = np.frombuffer(table, dtype, count)
    rows = rows[np.isfinite(rows["xyz"]).all(axis=1) & rows["xyz"].any(axis=1)]  # 0: no return
    since_ns = base_ns - stamp_ns if abs(base_ns - stamp_ns) < _SAME_CLOCK_NS else 0
    offsets_s = (rows["t"] + np.float64(since_ns)) / 1e9
    note = f"point times: offset_time, {np.ptp(offsets_s) if len(rows) else 0:.1g} s"
    return Sweep(rows["xyz"].copy(), frame_name(frame), stamp_ns, offsets_s, note)
