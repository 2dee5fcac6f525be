"""A map made again of the scans that its server kept."""

from contextlib import closing

import numpy as np
import pytest
import triquad_client
from scipy.spatial import cKDTree
from support import servers
from support.maps.small_world import world
from triquad_client import OfflineMap
from triquad_format.mapfile.checkpoint_folder import checkpoint_files, map_folder
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings, StoreSettings
from triquad_server.store.store import Store
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions
from triquad_tools.recordings.ros_recording import RosRecording

FAR_AWAY = np.array([448_262.0, 5_411_932.0, 120.0])
FORGOTTEN = FAR_AWAY + np.array([[-8.0, -12.0, -2.0], [2.0, 12.0, 8.0]])

EMPTY = FAR_AWAY + np.array([[8.0, -12.0, -2.0], [12.0, 12.0, 8.0]])


def settings(leaf_m: float) -> Settings:
    changed = {"log_max_bytes": 10**9, "period_s": 0}
    return Settings.model_validate({"field": {"leaf_m": leaf_m}, "store": changed})


def near(found: np.ndarray, others: np.ndarray) -> float:
    """The share of places [N, 3] that are within a voxel of others [M, 3]."""
    return float((cKDTree(others).query(found)[0] < 0.21).mean())


def poses(scans):
    for scan in scans:
        pose = scan.world_from_sensor.copy()
        pose[:3, 3] += FAR_AWAY
        yield scan, pose


def test_the_map_comes_from_the_kept_scans_again_and_at_another_leaf(tmp_path):
    drive = list(poses(world(6).scans))
    with (
        servers.running_service(settings(0.2), store=tmp_path) as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        for number, (scan, pose) in enumerate(drive):
            client.publish_scan(
                scan.points, pose, 1e9 + number, source="roof", no_return=scan.no_return
            )
            if number == 3:
                client.flush()
                client.checkpoint()
                client.reset(FORGOTTEN)  # of which the next scans see something again
        client.flush()
        client.reset(EMPTY)
    recording = open_recording(tmp_path, ReadingOptions())
    assert len(recording) == len(drive)
    assert {entry.source for entry in recording.entries} == {"roof"}
    newest = checkpoint_files(map_folder(tmp_path))[0].path
    with triquad_client.open_map(newest) as kept:
        expected = kept.surface_voxels()
    for leaf_m in (0.2, 0.4):
        mapper = Mapper("again", settings(leaf_m), "cpu")
        for scan in recording.read(range(len(recording))):
            mapper.ingest(scan.points, scan.world_from_sensor, no_return=scan.no_return)
        with OfflineMap(mapper.publish().record()) as again:
            found = again.surface_voxels()
            assert near(found, expected) > 0.995 or leaf_m != 0.2
            assert near(expected, found) > 0.995 or leaf_m != 0.2
            assert len(found) < 0.5 * len(expected) or leaf_m == 0.2
            assert not ((found > EMPTY[0] + 0.4) & (found < EMPTY[1] - 0.4)).all(1).any()


@pytest.mark.parametrize("log_max_bytes", [0, 10**9])
def test_what_was_reset_is_there_again_where_the_map_went_back(tmp_path, log_max_bytes):
    with servers.service_and_client(settings(0.2), tmp_path) as client:
        scan, pose = next(poses(world(6).scans))
        client.publish_scan(scan.points, pose, 1e9, source="roof")
        client.flush()
        kept = client.reset().kept_epoch
    with closing(Store(tmp_path, servers.MAP, StoreSettings(log_max_bytes=log_max_bytes))) as store:
        store.restore(kept)
        store.newest()
        store.log_scans(0.2)
    (again,) = open_recording(tmp_path, ReadingOptions()).read([0])
    assert len(again.points) > 1000


def test_other_tools_read_the_kept_scans_as_a_bag(tmp_path):
    drive = list(poses(world(6).scans))
    with servers.service_and_client(settings(0.2), tmp_path) as client:
        for number, (scan, pose) in enumerate(drive):
            client.publish_scan(scan.points, pose, 1e9 + number, source="roof")
        client.flush()
        client.checkpoint()
    file = min((map_folder(tmp_path) / "scans").glob("*.mcap"))
    recording = open_recording(file, ReadingOptions(points_in="sensor"))
    assert isinstance(recording, RosRecording)
    scans = list(recording.read(range(len(recording.entries))))
    assert len(scans) == len(drive)
    for found, (_, pose) in zip(scans, drive, strict=True):
        np.testing.assert_allclose(found.world_from_sensor, pose, atol=1e-6)
