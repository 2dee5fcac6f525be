"""A server whose map is larger than its memory: clients cannot tell, but for the status."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree
from support import servers
from support.poses import shifted
from triquad_client import Client, Mesh
from triquad_format.errors import RefusedError
from triquad_format.mapfile.reader import read_map
from triquad_format.records.status import Status
from triquad_server.settings import MemorySettings, Settings

MAX_BYTES = 12_000_000
LITTLE = Settings.model_validate(
    {
        "field": {"leaf_m": 0.2, "depth": 7},  # regions of 25.6 m
        "store": {"log_max_bytes": 10**9},
        "training": {"samples_per_ray": 1.0},
        "mesh": {"cell_m": 0.4},
        "memory": {"max_bytes": MAX_BYTES},
    }
)
MUCH = LITTLE.model_copy(update={"memory": Settings().memory})
SOME = LITTLE.model_copy(update={"memory": MemorySettings(max_bytes=28_000_000)})
PLACES = 10
APART_M = 50.0


def visit(client: Client, *places: int) -> None:
    """Publish a scan at each place, and see that it is taken in."""
    for place in places:
        pose = shifted(APART_M * place)
        client.publish_scan(servers.sphere(8000), pose, 1e9 + place, "roof")
        report = client.flush(servers.WAIT_S)
        assert (report.refused, report.lost) == (0, 0), report


def around(*places: int) -> NDArray[np.float64]:
    """Points around places."""
    directions = servers.sphere(500, 1.0)
    lengths = np.random.default_rng(0).uniform(0.5, 4.5, (len(directions), 1))
    points = (lengths * directions).astype(np.float64)
    return np.concatenate([points + [APART_M * place, 0.0, 0.0] for place in places])


def surfaces(client: Client, *places: int) -> NDArray[np.bool_]:
    """Whether a surface is known at each place."""
    return np.array([(client.query_sdf(around(p)).status == Status.SURFACE).any() for p in places])


def test_a_long_way_through_little_memory(tmp_path: Path) -> None:
    everywhere = around(*range(PLACES))
    with servers.service_and_client(MUCH, tmp_path / "much") as client:
        visit(client, *range(PLACES))
        client.settle(servers.WAIT_S)
        whole = client.query_sdf(everywhere)
        assert client.status().regions_cold == 0
    with servers.service_and_client(LITTLE, tmp_path / "little") as client:
        visit(client, *range(PLACES))
        status = client.status()
        assert status.regions_cold > PLACES // 2
        assert status.memory_parts["map"] == status.map_bytes < MAX_BYTES
        assert status.memory_parts["regions read to answer"] == 0
        status = client.settle(servers.WAIT_S)
        assert status.samples_left == 0, "regions came back, and learnt the rest"
        before = client.query_sdf(everywhere)
        np.testing.assert_array_equal(before.status, whole.status)
        near = np.abs(whole.sdf) < 0.5
        assert np.median(np.abs(before.sdf - whole.sdf)[near]) < 0.05
        assert client.status().memory_parts["regions read to answer"] > 0
    with servers.service_and_client(LITTLE, tmp_path / "little") as client:
        status = client.status()
        assert status.regions == status.regions_cold > PLACES
        assert status.settled
        servers.assert_same_map(before, client.query_sdf(everywhere))
        visit(client, 0, PLACES - 1)
        assert client.status().regions_cold < status.regions_cold


def test_who_follows_the_mesh_has_all_of_it(tmp_path: Path) -> None:
    """While regions leave memory and come back, and after a restart."""
    with servers.service_and_client(LITTLE, tmp_path) as client, client.watch_mesh() as watch:
        for place in range(PLACES):
            visit(client, place)
            watch.catch_up()
        client.settle(servers.WAIT_S)
        newest = client.mesh()
        watch.catch_up()
        assert_same_mesh(watch.mesh(), newest)
    with servers.service_and_client(LITTLE, tmp_path) as client, client.watch_mesh() as watch:
        watch.catch_up()
        assert_same_mesh(watch.mesh(), newest)


def assert_same_mesh(one: Mesh, other: Mesh) -> None:
    """Two meshes show the same surface, but for features that are rounded in a file."""
    assert len(one.faces) == pytest.approx(len(other.faces), rel=0.005)
    for mine, others in ((one, other), (other, one)):
        off_m, _ = KDTree(others.vertices).query(mine.vertices)
        assert np.quantile(off_m, 0.95) < 0.02
        assert off_m.max() < 2.0, "no tile is missing"


@pytest.mark.parametrize("training", [False, True])
def test_a_download_has_all_regions(tmp_path: Path, training: bool) -> None:
    with servers.service_and_client(SOME, tmp_path / "store") as client:
        visit(client, *range(8))
        status = client.status()
        assert status.regions_cold > 0
        client.download_map(tmp_path / "map.triquad", training=training)
    record = read_map(tmp_path / "map.triquad")
    assert len(record.regions) == status.regions
    assert all((region.training is not None) is training for region in record.regions)


def test_what_is_too_large_to_be_downloaded_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with servers.service_and_client(LITTLE, tmp_path / "store") as client:
        visit(client, *range(PLACES))
        with pytest.raises(RefusedError, match="where its store is, by triquad-pack"):
            client.download_map(tmp_path / "map.triquad")


def test_poses_of_what_left_memory_are_corrected(tmp_path: Path) -> None:
    nowhere = 3 * PLACES
    with servers.service_and_client(SOME, tmp_path) as client:
        client.publish_scan(servers.sphere(8000), shifted(APART_M * nowhere), 1e9 - 5, "roof")
        visit(client, *range(1, PLACES))
        assert client.status().regions_cold > 0
        assert surfaces(client, 0, nowhere).tolist() == [False, True]
        reply = client.correct_poses("roof", [1e9 - 5], [shifted(0.0)])
        assert (reply.scans_moved, reply.scans_learnt) == (1, 1)
        assert surfaces(client, 0, nowhere).tolist() == [True, False]
        assert surfaces(client, *range(1, PLACES)).all()


def test_what_is_reset_is_gone_wherever_it_was(tmp_path: Path) -> None:
    with servers.service_and_client(SOME, tmp_path) as client:
        visit(client, *range(PLACES))
        client.reset(((-10.0, -10.0, -10.0), (APART_M + 10.0, 10.0, 10.0)))
        assert surfaces(client, *range(4)).tolist() == [False, False, True, True]
        visit(client, PLACES)
        client.reset()
        assert client.status().regions == 0
        visit(client, PLACES + 1)
        assert surfaces(client, PLACES, PLACES + 1).tolist() == [False, True]
