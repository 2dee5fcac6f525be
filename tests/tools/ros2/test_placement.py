"""Sweeps that wait for transforms take no memory without end."""

import numpy as np
from triquad_tools.ros2.intake.placement import Motion, Placement
from triquad_tools.sensors.sweep import Sweep

POINT_BYTES = 12


def sweep(points: int, stamp_ns: int) -> Sweep:
    return Sweep(np.zeros((points, 3), np.float32), "lidar", stamp_ns)


def given_up(max_points: int, *points: int) -> list[int]:
    """The numbers of the sweeps that do not wait on, of some that came one after another."""
    placement = Placement(
        Motion(from_topic=False),
        map_frame="map",
        max_bytes=max_points * POINT_BYTES,
        timeout_s=60.0,
    )
    dropped = []
    for number, count in enumerate(points):
        placement.add(f"/lidar{number % 2}", sweep(count, number), now_s=float(number))
        dropped += [placed.sweep.stamp_ns for placed in placement.settle(float(number))]
    return dropped


def test_as_many_of_the_oldest_give_up_as_it_takes() -> None:
    assert given_up(2, 1, 1, 1, 1) == [0, 1]
    assert given_up(10, 3, 3, 3) == []
    assert sorted(given_up(10, 3, 3, 3, 7, 1)) == [0, 1, 2]
    assert given_up(10, 1, 11, 1) == [0, 1]
