"""A recorded drive over ROS 2 gives the map that the client's scans give."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from support import servers
from support.ros_bridge import Bridged, bridging
from support.ros_robot import SECOND, T0, robot
from triquad_server.settings import (
    ScanSettings,
    ServiceSettings,
    Settings,
    TrainingSettings,
)
from triquad_tools.evaluation.map_scores import score_withheld
from triquad_tools.recordings.cloud import is_withheld, world_points
from triquad_tools.recordings.folders.kitti import read_kitti_folder
from triquad_tools.recordings.folders.scan_folder import ScanFolder

SEOSAN = Path(__file__).resolve().parents[3] / "shared" / "data" / "seosan01"
PERIOD_S = 0.1
SCANS = 12
WITHHELD_EVERY = 4
RANGES_M = (2.0, 50.0)
SETTINGS = Settings(
    scan=ScanSettings(range_min_m=RANGES_M[0], range_max_m=RANGES_M[1]),
    training=TrainingSettings(samples_per_ray=12.0, samples_per_voxel=50.0),
    service=ServiceSettings(scan_queue=64),
)


Publish = Callable[[int], None]
"""Publishes the scan of a number."""


def mapped(
    folder: ScanFolder, endpoint: str, way: Callable[[Bridged], AbstractContextManager[Publish]]
) -> float:
    """The median |SDF| at scans that were withheld, of a map of the others, in metres."""
    withheld = [i for i in range(SCANS) if is_withheld(i, WITHHELD_EVERY)]
    taken = [i for i in range(SCANS) if i not in withheld]
    with bridging(endpoint) as bridged, way(bridged) as publish:
        started = time.monotonic()
        for number, index in enumerate(taken):
            time.sleep(max(0.0, started + number * PERIOD_S - time.monotonic()))
            publish(index)
        bridged.wait_for(lambda: bridged.accounted + bridged.lost >= len(taken))
        assert (bridged.taken, bridged.lost) == (len(taken), 0), bridged.bridge.dropped
        bridged.client.settle(600.0)
        clouds = (world_points(scan, *RANGES_M) for scan in folder.read(withheld))
        return score_withheld(bridged.client.query_sdf, clouds).sdf_median_m


def test_the_map_is_as_good_as_that_of_the_client() -> None:
    if not SEOSAN.is_dir():
        pytest.skip("real scans seosan01 are not in ../shared/data")
    folder = read_kitti_folder(SEOSAN)

    @contextmanager
    def by_client(bridged: Bridged) -> Iterator[Publish]:
        def publish(index: int) -> None:
            (scan,) = folder.read([index])
            bridged.client.publish_scan(scan.points, scan.world_from_sensor)

        yield publish

    @contextmanager
    def by_ros(bridged: Bridged) -> Iterator[Publish]:
        with robot(bridged.endpoint) as r2:

            def publish(index: int) -> None:
                (scan,) = folder.read([index])
                second = (folder.entries[index].stamp_ns - T0) / SECOND
                r2.cloud(second, scan.points)
                r2.tf(second, ("map", "lidar", scan.world_from_sensor))

            yield publish

    with servers.running_service(SETTINGS) as endpoint:
        client_m = mapped(folder, endpoint, by_client)
        ros_m = mapped(folder, endpoint, by_ros)
    assert ros_m == pytest.approx(client_m, abs=0.002)
