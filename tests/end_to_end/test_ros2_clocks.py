"""Time that goes back or leaps, and clocks that differ: no sensor falls silent for it."""

import itertools

import pytest
from support import servers
from support.ros_robot import robot
from support.ros_server import MAST, accounted, serving, stand, until
from triquad_client import ServerStatus


@pytest.mark.parametrize("transforms_first", [True, False])
def test_a_simulation_may_begin_anew(
    transforms_first: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with serving() as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 100, 101)
        r2.cloud(100.5, servers.sphere())
        until(client, lambda status: status.scans_taken == 1)
        if transforms_first:
            stand(r2, 0)
        r2.cloud(0.5, servers.sphere())
        stand(r2, 0, 1)
        status = until(client, lambda status: accounted(status) == 2)
        assert status.scans_taken == 2, status
    assert "time went back" in caplog.text


def test_a_bag_may_begin_anew_while_a_cloud_still_waits() -> None:
    with serving(waiting_s=60.0) as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 100, 101)
        r2.cloud(100.5, servers.sphere())
        until(client, lambda status: status.scans_taken == 1)
        r2.cloud(101.5, servers.sphere())  # whose transforms never come
        stand(r2, 0, 1)
        for number in range(5):
            r2.cloud(0.1 * number, servers.sphere())
        status = until(client, lambda status: accounted(status) == 7)
        assert (status.scans_taken, status.scans_dropped) == (6, {"began_anew": 1}), status


@pytest.mark.parametrize("ahead_s", [3, 3600])
def test_a_stamp_far_ahead_costs_one_cloud(ahead_s: int) -> None:
    with serving(waiting_s=60.0) as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        r2.cloud(0.1, servers.sphere())
        r2.cloud(0.2 + ahead_s, servers.sphere())
        for number in range(3, 9):
            r2.cloud(0.1 * number, servers.sphere())
        stand(r2, 0, 1)  # so that all of them waited
        status = until(client, lambda status: accounted(status) == 8)
        assert (status.scans_taken, status.scans_dropped) == (7, {"began_anew": 1}), status


def test_clocks_that_differ_do_not_matter_by_arrival() -> None:
    with serving(clock="arrival") as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 5)
        r2.cloud(-1e9, servers.sphere())
        later = itertools.count(6)

        def is_taken(status: ServerStatus) -> bool:
            stand(r2, next(later))
            return status.scans_taken == 1

        until(client, is_taken)
