"""Sweeps that wait for transforms take no memory without end."""

import numpy as np
from triquad_tools.ros2.intake.message_queue import WaitLimit
from triquad_tools.ros2.intake.motion import Motion
from triquad_tools.ros2.intake.placement import Placement
from triquad_tools.sensors.sweep import Sweep

POINT_BYTES = 12


def sweep(points: int, stamp_ns: int) -> Sweep:
    return Sweep(np.zeros((points, 3), np.float32), "lidar", stamp_ns)


def given_up(limit: WaitLimit, *points: int) -> list[int]:
    """The numbers of the sweeps that do not wait on, of some that came one after another."""
    placement = Placement(Motion(from_topic=False), map_frame="map", limit=limit, timeout_s=60.0)
    dropped = []
    for number, count in enumerate(points):
        placement.add(f"/lidar{number % 2}", sweep(count, number), now_s=float(number))
        dropped += [placed.sweep.stamp_ns for placed in placement.settle(float(number))]
    return dropped


def test_the_oldest_gives_up_where_too_many_wait() -> None:
    assert given_up(WaitLimit(messages=2, bytes=10**6), 1, 1, 1, 1) == [0, 1]


def test_as_many_of_the_oldest_give_up_as_it_takes_for_a_large_one() -> None:
    limit = WaitLimit(messages=100, bytes=10 * POINT_BYTES)
    assert given_up(limit, 3, 3, 3) == []
    assert sorted(given_up(limit, 3, 3, 3, 7, 1)) == [0, 1, 2]
    assert given_up(limit, 1, 11, 1) == [0, 1]
