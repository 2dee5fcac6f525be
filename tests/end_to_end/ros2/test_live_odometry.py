"""A robot with ROS 2 that has a lidar and nothing that says where it is."""

import numpy as np
import pytest
from numpy.typing import NDArray
from support import servers
from support.maps.small_world import world
from support.ros.ros_bridge import MAST, Bridged, bridging
from support.ros.ros_robot import robot
from triquad_tools.commands.ros2 import parser
from triquad_tools.console.command import ToolError
from triquad_tools.work.ros2 import bridge_options

SCANS, STEP_M = 24, 0.5


def drifted_m(bridged: Bridged, first: int) -> NDArray[np.float64]:
    """How far the trail lies from where the scans were taken, from number ``first`` on."""
    trail = bridged.client.sources().sources["points"].trail
    poses = np.array([scan.world_from_sensor for scan in world(SCANS, STEP_M).scans])
    there = np.linalg.inv(poses[0]) @ poses[first : first + len(trail)]
    return np.linalg.norm(trail - there[:, :3, 3], axis=1)


def test_its_map_is_made_by_its_clouds_alone() -> None:
    with (
        servers.running_service() as endpoint,
        bridging(endpoint, "--odometry", "points") as bridged,
        robot(endpoint) as r2,
    ):
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        for number, scan in enumerate(world(SCANS, STEP_M).scans):
            r2.tf(number, ("odom", "base_link", np.eye(4)))  # a driver that knows nothing
            r2.cloud(0.1 * number, scan.points)
        bridged.wait_for(lambda: bridged.accounted == SCANS)
        assert bridged.taken == SCANS, bridged.bridge.dropped
        assert drifted_m(bridged, 0).max() < 0.1


def test_a_scan_of_another_place_is_dropped_and_it_goes_on() -> None:
    scans = world(SCANS, STEP_M).scans
    with (
        servers.running_service() as endpoint,
        bridging(endpoint, "--odometry", "points") as bridged,
        robot(endpoint) as r2,
    ):
        for number in range(20):
            points = scans[number].points
            elsewhere = points[:, [2, 0, 1]] if number == 15 else points
            r2.cloud(0.1 * number, elsewhere)
        bridged.wait_for(lambda: bridged.accounted == 20)
        assert bridged.taken == 19
        assert bridged.bridge.dropped == {"lost": 1}
        assert np.delete(drifted_m(bridged, 0), slice(15, None)).max() < 0.1


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--poses", "/pose"), "leave out --poses and --corrections"),
        (("--corrections", "tf"), "leave out --poses and --corrections"),
        (("--clouds", "/other"), "name it in --clouds"),
    ],
)
def test_what_contradicts_it_is_refused(arguments: tuple[str, ...], told: str) -> None:
    with pytest.raises(ToolError, match=told):
        bridge_options(parser().parse_args(["--odometry", "/points", *arguments]))
