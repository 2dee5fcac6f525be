"""Maps in coordinates as large as UTM's: the same answers as near zero, moved."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import triquad_client
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import servers
from support.files.checkpoint_folder import write_record
from support.maps import small_world
from support.maps.exact_maps import exact_map, table
from support.poses import shifted
from triquad_client import ChangeKind, Client, Mesh, OfflineMap, Status, open_map
from triquad_client.calls.queries import MapQueries
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles
from triquad_server.errors import ScanRefusedError
from triquad_server.intake.map_origin import first_origin
from triquad_server.mapping.mapper import Mapper

FAR = np.array([450_000.0, 5_400_000.0, 400.0])
NEAR = np.zeros(3)
LEAST_M = 1e-3
RNG = np.random.default_rng(0)
POINTS = RNG.uniform((-8, -8, -1), (8, 8, 3), (500, 3))
ENDS = RNG.uniform((-8, -8, 1), (8, 8, 3), (500, 3))
EVERYWHERE = (-np.full(3, np.inf), np.full(3, np.inf))


def pose(at: Doubles, x: float = 0.0) -> Doubles:
    return shifted(*(at + [x, 0, 0]))


def box(at: Doubles, low: float = -5.0, high: float = 5.0) -> tuple[list[float], list[float]]:
    return (at + low).tolist(), (at + high).tolist()


def answers(view: MapQueries, at: Doubles) -> dict[str, NDArray[Any]]:
    """Answers of each kind about places around ``at``, with positions from there."""
    sdf = view.query_sdf(at + POINTS, gradient=True)
    ask = {"surface_point": True, "unknown_distance": True}
    found = view.query_distance(at + POINTS, 3.0, **ask)
    way = view.query_segments(at + POINTS, at + ENDS, 0.1)
    cells = view.query_grid(box(at), 0.5)
    ground = view.query_ground(at + POINTS, 5.0)
    return {
        "sdf": sdf.sdf,
        "sdf gradient": sdf.gradient,
        "sdf status": sdf.status,
        "distance": found.distance_m,
        "gradient": found.gradient,
        "status": found.status,
        "surface point": found.surface_point - at,
        "unknown point": found.unknown_point - at,
        "spheres": view.query_spheres(at + POINTS, 0.5).status,
        "contact": way.contact_m,
        "clearance": way.clearance_m,
        "polyline": np.array(view.query_polyline(at + ENDS[:20], 0.1).clearance_m),
        "rays": view.query_rays(at + ENDS, POINTS - ENDS, 30.0).range_m,
        "height": ground.height_m - at[2],
        "cells": cells.distance_m,
        "corner": cells.shape.corner - at,
    }


def assert_same(have: dict[str, NDArray[Any]], want: dict[str, NDArray[Any]]) -> None:
    for name, there in want.items():
        np.testing.assert_allclose(have[name], there, atol=LEAST_M, err_msg=name)


def assert_same_mesh(have: Mesh, want: Mesh, at: Doubles) -> None:
    """Tiles come in any order."""
    assert len(have.faces) == len(want.faces) > 100
    assert len(have.vertices) == len(want.vertices)  # no seams
    corners = [
        np.sort((mesh.vertices[mesh.faces] - off).mean(axis=1).round(5), axis=0)
        for mesh, off in ((have, at), (want, NEAR))
    ]
    np.testing.assert_allclose(*corners, atol=LEAST_M)


@dataclass(frozen=True)
class Places:
    """One map, as a file near zero and as one far away."""

    near: Path
    far: Path


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Places:
    folder = tmp_path_factory.mktemp("far")
    record = replace(exact_map(table(0.0, 1.0), epoch=5), name=servers.MAP)
    far = replace(record, origin_m=tuple(FAR.tolist()))
    write_map(record, folder / "near.triquad", feature_dtype="<f4")
    write_map(far, folder / "far.triquad", feature_dtype="<f4")
    for name, one in (("near", record), ("far", far)):
        (folder / name / servers.MAP).mkdir(parents=True)
        write_record(folder / name / servers.MAP, one)
    return Places(folder / "near.triquad", folder / "far.triquad")


def test_a_file_answers_where_its_scans_were(places: Places) -> None:
    with open_map(places.near) as near, open_map(places.far) as far:
        assert_same(answers(far, FAR), answers(near, NEAR))
        assert_same_mesh(far.mesh(box(FAR)), near.mesh(box(NEAR)), FAR)
        np.testing.assert_array_equal(far.has_surface(FAR + POINTS), near.has_surface(POINTS))
        np.testing.assert_allclose(far.surface_voxels() - FAR, near.surface_voxels(), atol=1e-6)
        np.testing.assert_array_equal(far.origin_m, FAR)
        with open_map(places.far, coordinates="local") as local:
            assert_same(answers(local, NEAR), answers(near, NEAR))
            assert_same_mesh(local.mesh(), near.mesh(), NEAR)


def test_a_server_answers_where_its_scans_were(places: Places, tmp_path: Path) -> None:
    with ExitStack() as opened:
        near, far = (
            opened.enter_context(servers.service_and_client(store=path.with_suffix("")))
            for path in (places.near, places.far)
        )
        assert far.status().epoch == near.status().epoch
        want = answers(near, NEAR)
        assert_same(answers(far, FAR), want)
        assert_same_mesh(far.mesh(box(FAR)), near.mesh(box(NEAR)), FAR)
        with far.watch_mesh(box(FAR)) as watch, near.watch_mesh(box(NEAR)) as other:
            watch.catch_up()
            other.catch_up()
            assert_same_mesh(watch.mesh(), other.mesh(), FAR)
            again = far.watch_mesh(box(FAR), known=watch.known_tiles())
            assert_same_mesh(again.mesh(), other.mesh(), FAR)
            again.catch_up()
            assert all(again.tiles[index] is tile for index, tile in watch.tiles.items())
        copy = far.sync(box(FAR, -9.0, 9.0), tmp_path / "copy.triquad")
        assert_same(answers(copy, FAR), want)


@contextmanager
def server_and_clients() -> Iterator[tuple[Client, Client]]:
    """A server without a map, a client of it, and one that speaks local coordinates."""
    with (
        servers.running_service() as endpoint,
        triquad_client.connect(endpoint) as client,
        triquad_client.connect(endpoint, coordinates="local") as local,
    ):
        yield client, local


def test_a_map_is_made_far_away(tmp_path: Path) -> None:
    with server_and_clients() as (client, local):
        assert not client.origin_m.any()
        before = client.changes()
        near_by = FAR + [12.0, -30.0, 3.0]
        for step in range(3):
            client.publish_scan(servers.sphere(20_000), pose(near_by, 0.01 * step))
        assert client.flush(servers.WAIT_S).refused == 0
        client.settle(servers.WAIT_S)
        for origin_m in (client.origin_m, local.origin_m, client.status().origin_m):
            np.testing.assert_array_equal(origin_m, FAR)
        fit = client.status().fit
        assert fit is not None
        assert np.abs(fit.worst - near_by).max() < 10.0
        ends = near_by + servers.sphere(200)
        assert (client.query_distance(ends).status == Status.SURFACE).all()
        assert np.median(np.abs(client.query_distance(ends).distance_m)) < 0.02
        have = client.query_distance(ends, 3.0, surface_point=True)
        want = local.query_distance(ends - FAR, 3.0, surface_point=True)
        np.testing.assert_allclose(have.surface_point - FAR, want.surface_point, atol=1e-5)

        source = client.sources().sources["default"]
        assert source.newest is not None
        np.testing.assert_allclose(source.trail[0], near_by, atol=1e-6)
        np.testing.assert_allclose(source.newest.position_m, near_by + [0.02, 0, 0], atol=1e-6)
        off_m = np.linalg.norm(source.newest.points_m - source.newest.position_m, axis=1)
        np.testing.assert_allclose(off_m, servers.RADIUS_M, atol=LEAST_M)
        boxes = client.changes(before).boxes
        assert {one.kind for one in boxes} == {ChangeKind.APPEARED}
        low = np.min([one.minimum for one in boxes], axis=0) - near_by
        np.testing.assert_allclose(low, -servers.RADIUS_M, atol=0.3)
        guess = pose(near_by, 0.1)
        found = client.align(servers.sphere(3000), guess).world_from_sensor
        np.testing.assert_allclose(found[:3, 3], near_by, atol=0.02)

        client.download_map(tmp_path / "map.triquad")
        with open_map(tmp_path / "map.triquad") as offline:
            assert_same_map(offline, client, near_by)
        local.publish_scan(servers.sphere(), pose(near_by - FAR, 5.0))
        assert local.flush(servers.WAIT_S).taken == 1
        np.testing.assert_array_equal(client.origin_m, FAR)
        client.publish_scan(servers.sphere(), pose(NEAR))
        report = client.flush(servers.WAIT_S)
        assert report.refused == 1
        assert "origin 450000 5400000 400" in str(report.last_refusal)

        client.reset((near_by - 1.0, near_by + 20.0))
        status = client.query_distance(ends).status
        gone = (ends > near_by - 0.5).all(axis=1)
        assert (status[gone] == Status.UNKNOWN).all()
        assert (status[(ends < near_by - 1.5).any(axis=1)] == Status.SURFACE).all()


def assert_same_map(offline: MapQueries, client: Client, at: Doubles) -> None:
    """The field is the same but for the rounding of features."""
    points = at + RNG.uniform(-4.5, 4.5, (2000, 3))
    have, want = offline.query_distance(points), client.query_distance(points)
    np.testing.assert_array_equal(have.status, want.status)
    assert np.quantile(np.abs(have.distance_m - want.distance_m), 0.99) < LEAST_M


def test_poses_that_jump_far_away_are_refused() -> None:
    """As where a first GPS fix comes late: nothing of the map is elsewhere than it seems."""
    with servers.service_and_client() as client:
        for at in (NEAR, FAR, FAR):
            client.publish_scan(servers.sphere(), pose(at))
        report = client.flush(servers.WAIT_S)
        assert (report.taken, report.refused) == (1, 2)
        assert "origin 0 0 0, which the first scan" in str(report.last_refusal)
        assert client.status().scans_dropped == {"outside_world": 2}
        assert not client.origin_m.any()
        assert (client.query_distance(FAR + POINTS).status == Status.UNKNOWN).all()


def test_a_local_map_has_no_origin() -> None:
    with servers.running_service() as endpoint:
        with triquad_client.connect(endpoint, coordinates="local") as local:
            local.publish_scan(servers.sphere(), pose(NEAR, 20_000.0))
            assert local.flush(servers.WAIT_S).taken == 1
            assert not local.origin_m.any()
        with pytest.raises(triquad_client.InvalidInputError, match="coordinates = 'utm'"):
            triquad_client.connect(endpoint, coordinates="utm")


def test_the_same_drive_gives_the_same_map() -> None:
    """Bit by bit, where poses are given in micrometres: the mapper's own numbers are the same."""
    epochs = []
    for at in (NEAR, FAR):
        mapper = Mapper("drive", small_world.settings(), "cpu")
        for scan in small_world.world(3).scans:
            moved = scan.world_from_sensor.copy()
            moved[:3, 3] = moved[:3, 3].round(6) + at
            mapper.ingest(scan.points, moved)
        small_world.settle(mapper)
        np.testing.assert_array_equal(mapper.origin, at)
        epochs.append(mapper.publish())
    near, far = (OfflineMap(epoch.record()) for epoch in epochs)
    assert_same(answers(far, FAR), answers(near, NEAR))
    assert_same_mesh(far.mesh(), near.mesh(), FAR)
    hits = small_world.world(3).hits[::50]
    np.testing.assert_array_equal(far.query_sdf(FAR + hits).sdf, near.query_sdf(hits).sdf)


@given(st.tuples(*[st.floats(-2e9, 2e9)] * 3))
@settings(max_examples=200)
def test_an_origin_is_exact_and_near(position: tuple[float, float, float]) -> None:
    origin = first_origin(pose(np.array(position)))
    assert (origin % 100 == 0).all()
    farthest = max(map(abs, position))
    if 10_000 < farthest <= 1e9:
        assert np.abs(origin - position).max() <= 50.0
    else:
        assert not origin.any()


def test_a_place_beyond_all_is_refused() -> None:
    mapper = Mapper("far", servers.SMALL, "cpu")
    with pytest.raises(ScanRefusedError, match="from the map's origin 0 0 0"):
        mapper.ingest(servers.sphere(), pose(NEAR, 1e12))
    mapper.ingest(servers.sphere(), pose(FAR))  # which chooses
    np.testing.assert_array_equal(mapper.origin, FAR)
    mapper.reset(*EVERYWHERE)
    with pytest.raises(ScanRefusedError, match="origin 450000 5400000 400"):
        mapper.ingest(servers.sphere(), pose(NEAR))
    emptied = mapper.snapshot_since(None).record()
    again = Mapper("far", servers.SMALL, "cpu", record=emptied)
    again.ingest(servers.sphere(), pose(NEAR))
    assert not again.origin.any()
