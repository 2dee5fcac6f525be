"""``sensor_msgs/PointCloud2``: clouds as nearly all lidars publish them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Floats

from triquad_tools.sensors.point_times import offsets_s, time_fields
from triquad_tools.sensors.ros.type_store import frame_name, stamp_ns
from triquad_tools.sensors.sweep import NoScanError, Sweep

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""The types of the message's constants INT8 to FLOAT64."""


def sweep_of_cloud(message: Any) -> Sweep:
    """Return the finite points of a ``PointCloud2``, with their times where it has some.

    Raises:
        NoScanError: it has no x, y and z, or not as floating numbers, or is not whole.
    """
    fields = {field.name: field for field in message.fields}
    _check_layout(message)
    points = _points(message, fields)
    stamp = stamp_ns(message.header)
    finite = np.isfinite(points)
    kept = slice(None) if finite.all() else finite.all(axis=1)
    offsets, note = None, "no point times: motion is not taken out"
    for name in time_fields(fields):
        times = _column(message, fields[name]).reshape(-1)
        offsets = offsets_s(times[kept], stamp, name)
        if offsets is not None:
            note = f"point times: {name}, {np.ptp(offsets):.1g} s"
            break
    return Sweep(points[kept], frame_name(message.header.frame_id), stamp, offsets, note)


def _points(message: Any, fields: dict[str, Any]) -> Floats:
    """Return the points [N, 3], the one copy that is made of them."""
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise NoScanError(
            "no_xyz",
            f"the cloud has no field {', '.join(missing)}, only {', '.join(fields) or 'none'}: "
            "choose a topic of points",
        )
    columns = [_column(message, fields[name]) for name in "xyz"]
    kinds = [column.dtype.kind for column in columns]
    if kinds != ["f", "f", "f"]:
        raise NoScanError(
            "field_type",
            f"x, y and z of the cloud are {', '.join(str(c.dtype) for c in columns)}: only "
            "FLOAT32 and FLOAT64 are understood",
        )
    # Column by column, which is three times as fast as three numbers at a time.
    points = np.empty((*columns[0].shape, 3), np.float32)
    for axis, column in enumerate(columns):
        points[..., axis] = column
    return points.reshape(-1, 3)


def _column(message: Any, field: Any) -> NDArray[Any]:
    """Return a view [height, width] of one field."""
    if field.datatype not in _TYPES or field.count > 1:
        raise NoScanError(
            "field_type",
            f"the cloud's field {field.name} has the type {field.datatype} and {field.count} "
            "values a point: a type from 1 to 8 and one value are understood",
        )
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(order + _TYPES[field.datatype])
    if field.offset + dtype.itemsize > message.point_step:
        raise NoScanError(
            "truncated",
            f"the cloud's field {field.name} ends at byte {field.offset + dtype.itemsize} of a "
            f"point of {message.point_step}",
        )
    strides = (_row_step(message), message.point_step)
    shape = (message.height, message.width)
    if 0 in shape:
        return np.empty(shape, dtype)
    return np.asarray(np.ndarray(shape, dtype, message.data, field.offset, strides))


def _row_step(message: Any) -> int:
    """Return the bytes from row to row; drivers leave it 0 if there is one row."""
    return int(message.row_step or message.width * message.point_step)


def _check_layout(message: Any) -> None:
    row = message.width * message.point_step
    needed = (message.height - 1) * _row_step(message) + row if message.height else 0
    if row > _row_step(message) or needed > len(message.data):
        raise NoScanError(
            "truncated",
            f"the cloud says {message.height} x {message.width} points of {message.point_step} "
            f"bytes, which are {needed} bytes, but has {len(message.data)}",
        )
