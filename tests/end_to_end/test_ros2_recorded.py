"""A recorded drive over ROS 2 gives the map that the client's scans give."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import triquad_client
from support import servers
from support.ros_robot import SECOND, T0, robot
from support.ros_server import accounted, until
from triquad_client import Client
from triquad_server.settings import (
    Ros2Settings,
    ScanSettings,
    ServiceSettings,
    Settings,
    TrainingSettings,
)
from triquad_tools.evaluation.map_scores import ask_withheld, score_withheld
from triquad_tools.recordings.cloud import is_withheld, world_points
from triquad_tools.recordings.folders.kitti import KittiFolder, read_kitti_folder

SEOSAN = Path(__file__).resolve().parents[3] / "shared" / "data" / "seosan01"
PERIOD_S = 0.1
SCANS = 12
WITHHELD_EVERY = 4
RANGES_M = (2.0, 50.0)
SETTINGS = Settings(
    scan=ScanSettings(range_min_m=RANGES_M[0], range_max_m=RANGES_M[1]),
    training=TrainingSettings(samples_per_ray=12.0, samples_per_voxel=50.0),
    service=ServiceSettings(scan_queue=64),
    ros2=Ros2Settings(enabled=True),
)


Publish = Callable[[int], None]
"""Publishes the scan of a number."""


def mapped(
    folder: KittiFolder, way: Callable[[Client, str], AbstractContextManager[Publish]]
) -> float:
    """The median |SDF| at scans that were withheld, of a map of the others, in metres."""
    withheld = [i for i in range(SCANS) if is_withheld(i, WITHHELD_EVERY)]
    taken = [i for i in range(SCANS) if i not in withheld]
    with (
        servers.running_service(SETTINGS) as endpoint,
        triquad_client.connect(endpoint) as client,
        way(client, endpoint) as publish,
    ):
        started = time.monotonic()
        for number, index in enumerate(taken):
            time.sleep(max(0.0, started + number * PERIOD_S - time.monotonic()))
            publish(index)
        status = until(
            client, lambda status: accounted(status) + sum(status.scans_lost.values()) >= len(taken)
        )
        assert (status.scans_taken, status.scans_lost) == (len(taken), {}), status
        client.settle(600.0)
        clouds = (world_points(scan, *RANGES_M) for scan in folder.read(withheld))
        return score_withheld(ask_withheld(client.query_sdf, clouds)).sdf_median_m


def test_the_map_is_as_good_as_that_of_the_client() -> None:
    if not SEOSAN.is_dir():
        pytest.skip("real scans seosan01 are not in ../shared/data")
    folder = read_kitti_folder(SEOSAN)

    @contextmanager
    def by_client(client: Client, _: str) -> Iterator[Publish]:
        yield lambda index: client.publish_scan(folder.read_points(index), folder.poses[index])

    @contextmanager
    def by_ros(_: Client, endpoint: str) -> Iterator[Publish]:
        with robot(endpoint) as r2:

            def publish(index: int) -> None:
                second = (int(folder.stamps_ns[index]) - T0) / SECOND
                r2.cloud(second, folder.read_points(index))
                r2.tf(second, ("map", "lidar", folder.poses[index]))

            yield publish

    client_m, ros_m = mapped(folder, by_client), mapped(folder, by_ros)
    assert ros_m == pytest.approx(client_m, abs=0.002)
