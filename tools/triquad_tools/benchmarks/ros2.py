"""``triquad-bench`` on messages of ROS 2: how long it takes to read a cloud."""

from typing import Any

import numpy as np
from triquad_sensors.ros.point_cloud import sweep_of_cloud
from triquad_sensors.ros.type_store import POINT_CLOUD, decode_cdr, encode_cdr, type_store

from triquad_tools.benchmarks.figures import Figure, compare

_POINTS = 200_000
_ROUNDS, _REPEATS = 9, 7
_FIELDS = {"x": 7, "y": 7, "z": 7, "intensity": 7, "t": 6}
"""Fields of a cloud, of four bytes each, and their types: as drivers of spinning lidars do."""

_POINT = np.dtype([(name, "<f4" if kind == 7 else "<u4") for name, kind in _FIELDS.items()])


def measure_ros2(street_seed: int) -> list[Figure]:
    """Figures of reading a cloud of 200,000 points, each with its time."""
    payload = _cloud(np.random.default_rng(street_seed))
    result = compare(
        lambda: sweep_of_cloud(decode_cdr(payload, POINT_CLOUD)),
        lambda: np.array(np.frombuffer(payload, np.uint8)),
        _ROUNDS,
        _REPEATS,
    )
    name = f"PointCloud2 of {_POINTS:,} points with times, read"
    return [
        Figure(name, 1e3 * result.seconds, "ms", at_most=2.0),
        Figure("the same, in copies of its bytes", 1 / result.ratio, ""),
    ]


def _cloud(rng: np.random.Generator) -> bytes:
    """A cloud as its bytes."""
    rows = np.zeros(_POINTS, _POINT)
    for axis in "xyz":
        rows[axis] = rng.normal(size=_POINTS) * 10
    rows["t"] = np.linspace(0, 1e8, _POINTS)  # nanoseconds since the first

    def new(name: str, *values: Any) -> Any:
        return type_store().types[name](*values)

    fields = [
        new("sensor_msgs/msg/PointField", name, 4 * number, kind, 1)
        for number, (name, kind) in enumerate(_FIELDS.items())
    ]
    header = new("std_msgs/msg/Header", new("builtin_interfaces/msg/Time", 1, 0), "lidar")
    step = _POINT.itemsize
    data = rows.view(np.uint8)
    sizes = (1, _POINTS, fields, False, step, step * _POINTS, data, True)
    return encode_cdr(new(POINT_CLOUD, header, *sizes), POINT_CLOUD)
