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
