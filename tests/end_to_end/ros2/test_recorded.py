"""A recorded drive over ROS 2 gives the scans that the client publishes."""

from pathlib import Path

import numpy as np
import pytest
from support import servers
from support.ros.ros_bridge import Bridged, bridging
from support.ros.ros_robot import SECOND, T0, robot
from triquad_client import ScanSource
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder

SEOSAN = Path(__file__).resolve().parents[4] / "shared" / "data" / "seosan01"
SCANS = 3
MOST_POINTS = 10_000  # that a server tells of a scan


def told(bridged: Bridged) -> ScanSource:
    """What the server has of the only source."""
    bridged.wait_for(lambda: bridged.taken == SCANS)
    (source,) = bridged.client.sources(max_points=MOST_POINTS).sources.values()
    return source


def test_scans_of_a_robot_are_those_of_the_client() -> None:
    if not SEOSAN.is_dir():
        pytest.skip("real scans seosan01 are not in ../shared/data")
    folder = read_cloud_folder(SEOSAN)
    with servers.running_service() as endpoint:
        with bridging(endpoint) as bridged:
            for index in range(SCANS):
                (scan,) = folder.read([index])
                bridged.client.publish_scan(scan.points, scan.world_from_sensor)
                bridged.client.flush(servers.WAIT_S)
            by_client = told(bridged)
        with bridging(endpoint) as bridged, robot(endpoint) as r2:
            for index in range(SCANS):
                (scan,) = folder.read([index])
                second = (folder.entries[index].stamp_ns - T0) / SECOND
                r2.cloud(second, scan.points)
                r2.tf(second, ("map", "lidar", scan.world_from_sensor))
            by_robot = told(bridged)
    np.testing.assert_allclose(by_robot.trail, by_client.trail, atol=1e-6)
    assert len(by_robot.newest.points) > 1000
    np.testing.assert_allclose(by_robot.newest.points_m, by_client.newest.points_m, atol=1e-3)
