"""Time that goes back or leaps, and clocks that differ: no sensor falls silent for it."""

from collections.abc import Iterator

import pytest
from support import servers
from support.ros.ros_bridge import bridging, stand
from support.ros.ros_robot import robot


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with servers.running_service() as endpoint:
        yield endpoint


@pytest.mark.parametrize("transforms_first", [True, False])
def test_a_simulation_may_begin_again(
    endpoint: str, transforms_first: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        stand(r2, 100, 101)
        r2.cloud(100.5, servers.sphere())
        bridged.wait_for(lambda: bridged.taken == 1)
        if transforms_first:
            stand(r2, 0)
        r2.cloud(0.5, servers.sphere())
        stand(r2, 0, 1)
        bridged.wait_for(lambda: bridged.accounted == 2)
        assert bridged.taken == 2, bridged.bridge.dropped
    assert "time went back" in caplog.text


def test_a_bag_may_begin_again_while_a_cloud_still_waits(endpoint: str) -> None:
    with bridging(endpoint, "--wait-s", 60) as bridged, robot(endpoint) as r2:
        stand(r2, 100, 101)
        r2.cloud(100.5, servers.sphere())
        bridged.wait_for(lambda: bridged.taken == 1)
        r2.cloud(101.5, servers.sphere())  # whose transforms never come
        stand(r2, 0, 1)
        for number in range(5):
            r2.cloud(0.1 * number, servers.sphere())
        bridged.wait_for(lambda: bridged.accounted == 7)
        assert (bridged.taken, bridged.bridge.dropped) == (6, {"restarted": 1})


@pytest.mark.parametrize("ahead_s", [3, 3600])
def test_a_stamp_far_ahead_costs_one_cloud(endpoint: str, ahead_s: int) -> None:
    with bridging(endpoint, "--wait-s", 60) as bridged, robot(endpoint) as r2:
        r2.cloud(0.1, servers.sphere())
        r2.cloud(0.2 + ahead_s, servers.sphere())
        for number in range(3, 9):
            r2.cloud(0.1 * number, servers.sphere())
        stand(r2, 0, 1)  # so that all of them waited
        bridged.wait_for(lambda: bridged.accounted == 8)
        assert (bridged.taken, bridged.bridge.dropped) == (7, {"restarted": 1})


def test_a_stamp_a_little_before_the_last_costs_that_cloud(endpoint: str) -> None:
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        stand(r2, 0, 1)
        for second in (0.1, 0.5, 0.3, 0.7):
            r2.cloud(second, servers.sphere())
        bridged.wait_for(lambda: bridged.accounted == 4)
        assert (bridged.taken, bridged.bridge.dropped) == (3, {"time_backwards": 1})


def test_what_cannot_be_placed_is_counted_by_its_reason(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    with bridging(endpoint, "--wait-s", 1.0) as bridged, robot(endpoint) as r2:
        r2.cloud(0, servers.sphere())
        bridged.wait_for(lambda: bridged.bridge.dropped == {"no_transform": 1})
        stand(r2, 10, 10.1, 20)
        for second in (5, 15, 25):
            r2.cloud(second, servers.sphere())
        bridged.wait_for(lambda: bridged.accounted == 4)
        reasons = ("no_transform", "pose_early", "pose_gap", "pose_late")
        assert bridged.bridge.dropped == dict.fromkeys(reasons, 1)
        assert bridged.lost == 0
    assert "/points: 1 dropped, no_transform: " in caplog.text
    assert "use --clock arrival" in caplog.text


def test_clocks_that_differ_do_not_matter_by_arrival(endpoint: str) -> None:
    with bridging(endpoint, "--clock", "arrival") as bridged, robot(endpoint) as r2:
        stand(r2, 5)
        for cloud in (1, 2):  # on another topic, the first may be there before the first pose
            r2.cloud(-1e9 + cloud, servers.sphere())
            bridged.send_until(
                lambda later: stand(r2, 5 + later), lambda cloud=cloud: bridged.accounted == cloud
            )
        early = bridged.bridge.dropped.get("pose_early", 0)
        assert bridged.taken == 2 - early >= 1, bridged.bridge.dropped
