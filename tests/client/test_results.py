"""What a person sees of clients, maps and results at a prompt, and does with them."""

import asyncio
import dataclasses
import pydoc
import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import triquad_client
from support import servers
from support.maps.exact_maps import exact_map, table
from triquad_client import Mesh, OfflineMap, Status
from triquad_server import serve

matplotlib.use("agg")
POINTS = np.array([[0.0, 0, 1.5], [0, 0, 0.0], [0, 0, -30.0], [2.0, 1, 1.2], [90, 90, 90]])
BOX = ((-2, -2, 0), (2, 2, 2))


@pytest.fixture(scope="module")
def offline() -> OfflineMap:
    return OfflineMap(exact_map(table(0.1, 1.1)))


@pytest.mark.parametrize(
    "kind",
    [
        triquad_client.Alignment,
        triquad_client.Distances,
        triquad_client.Grid,
        triquad_client.Ground,
        Mesh,
        triquad_client.RayRanges,
        triquad_client.SdfResult,
        triquad_client.Segments,
        triquad_client.Spheres,
    ],
)
def test_help_tells_what_each_field_of_a_result_is(kind: type) -> None:
    """For arrays that is their shape as well."""
    told = pydoc.plain(pydoc.render_doc(kind))
    for field in dataclasses.fields(kind):
        if field.name == "epoch" or field.name.startswith("_"):
            continue
        line = re.search(rf"^ \|      {field.name}: (.+)$", told, re.MULTILINE)
        assert line is not None, field.name
        is_array = field.type not in ("float", "int", "bool", "GridShape")
        assert bool(re.match(r"\[[\w, ]+\] ", line[1])) == is_array, line[1]


def test_results_are_told_in_a_line(offline: OfflineMap) -> None:
    counted = offline.query_sdf(POINTS).status.counted()
    told = [
        (offline.query_sdf(POINTS), f"SdfResult(5 points: {counted}; epoch 1)"),
        (offline.query_distance(POINTS), f"Distances(5 points: {counted}; epoch 1)"),
        (offline.query_distance(POINTS[:0]), "Distances(0 points; epoch 1)"),
        (offline.query_segments(POINTS, POINTS + 0.1), "Segments(5 segments: "),
        (offline.query_rays(POINTS, POINTS + 1), "RayRanges(5 rays: "),
        (offline.query_spheres(POINTS, 0.1), "Spheres(5 spheres: "),
        (offline.query_ground(POINTS), "Ground(5 points: "),
        (offline.query_grid(BOX, 0.5), "Grid(8 x 8 x 4 cells of 0.5 m: "),
        (offline.mesh(BOX, 0.1), "Mesh("),
        (offline, "OfflineMap('ground', 1 regions; epoch 1)"),
    ]
    for result, line in told:
        assert repr(result).startswith(line)
        assert "\n" not in repr(result)
    assert "UNKNOWN" in counted


def test_a_part_of_a_result_is_the_result_of_that_part(offline: OfflineMap) -> None:
    whole = offline.query_distance(POINTS, surface_point=True)
    for part in (slice(1, 4), np.array([3, 0]), np.arange(5) % 2 == 0, 2, -1):
        expected = offline.query_distance(np.atleast_2d(POINTS[part]), surface_point=True)
        found = whole[part]
        assert len(found) == len(expected)
        assert np.allclose(found.surface_point, expected.surface_point, rtol=0, atol=1e-5)
        assert np.array_equal(found.status, expected.status)
    assert [len(one) for one in whole] == [1] * 5
    for outside in (5, np.zeros((2, 2), int), np.argwhere(whole.distance_m > 0), None):
        with pytest.raises(IndexError):
            whole[outside]
    with pytest.raises(triquad_client.NotAskedError):
        _ = whole[0].unknown_point


def test_statuses_are_numbers_that_print_as_names(offline: OfflineMap) -> None:
    status = offline.query_sdf(POINTS).status
    assert status.dtype == np.uint8
    assert str(status[:1]) in ("[FREE]", "[SURFACE]", "[UNKNOWN]")
    assert repr(status[-1:]) == "Statuses([UNKNOWN])"
    seen = status != Status.UNKNOWN
    assert type(seen) is np.ndarray
    assert repr(seen[-1:]) == "array([False])"
    assert (status == Status.UNKNOWN).mean() > 0


def test_results_become_tables(offline: OfflineMap) -> None:
    answer = offline.query_distance(POINTS, surface_point=True)
    frame = answer.to_pandas()
    assert list(frame["status"]) == [Status(one).name for one in answer.status]
    assert np.array_equal(frame[["gradient_x", "gradient_y", "gradient_z"]], answer.gradient)
    assert np.array_equal(frame["surface_point_z"], answer.surface_point[:, 2])
    assert len(frame) == len(answer)


def test_a_layer_of_a_grid_is_drawn_where_it_is(offline: OfflineMap, tmp_path: Path) -> None:
    grid = offline.query_grid(((-2, -1, 0), (2, 2, 2)), 0.5)
    axes = grid.plot(layer=1)
    (image,) = axes.images
    assert tuple(image.get_extent()) == (-2.0, 2.0, -1.0, 2.0)
    drawn = np.ma.filled(image.get_array().astype(float), np.nan)
    known = grid.status[:, :, 1] != Status.UNKNOWN
    assert np.array_equal(np.isfinite(drawn), known.T)
    assert np.array_equal(drawn[known.T], grid.distance_m[:, :, 1].T[known.T])
    assert "z = 0.75 m" in axes.get_title()
    axes.figure.savefig(tmp_path / "grid.png")


def test_the_ground_is_drawn_where_it_is(offline: OfflineMap, tmp_path: Path) -> None:
    points = np.array([[0.0, 0, 1.5], [2.0, 1, 1.2], [0.5, 0.5, 9.0], [90, 90, 90]])
    ground = offline.query_ground(points)
    assert np.array_equal(ground.points, points)
    axes = ground.plot()
    heights, none = axes.collections
    for kind, drawn in ((Status.SURFACE, heights), (Status.FREE, none)):
        assert np.array_equal(drawn.get_offsets(), points[ground.status == kind, :2])
    assert np.array_equal(heights.get_array(), ground.height_m[ground.status == Status.SURFACE])
    assert len(heights.get_array()) > 0
    axes.figure.savefig(tmp_path / "ground.png")
    assert ground[:0].plot(axes) is axes, "nothing is drawn of nothing"


@pytest.mark.parametrize("name", sorted({*triquad_client.__all__} - {"__version__", "Statuses"}))
def test_help_names_types_as_programs_do(name: str) -> None:
    told = pydoc.render_doc(getattr(triquad_client, name), renderer=pydoc.plaintext)
    for expanded in ("numpy._typing", "collections.abc.Sequence[", "numpy.dtype[", "<function"):
        assert expanded not in told


def test_servers_clients_and_what_they_give_say_what_they_are(tmp_path: Path) -> None:
    with serve(settings=servers.SMALL) as server, server.client() as client:
        servers.learn_all(client)
        assert repr(server) == f"Server(map 'default' at {server.endpoint})"
        assert repr(client) == f"Client(map 'default' to {server.endpoint})"
        assert repr(client.pinned()).startswith("PinnedMap(epoch ")
        with client.watch_mesh(BOX) as watch:
            watch.next(servers.WAIT_S)
            assert repr(watch).startswith("MeshWatch(")
        synced = client.sync(BOX, tmp_path / "part.triquad")
        assert repr(synced).startswith(f"SyncedMap({tmp_path / 'part.triquad'}, ")

        async def told() -> str:
            async with triquad_client.connect_async(server.endpoint) as waiting:
                return repr(waiting)

        assert asyncio.run(told()) == f"AsyncClient(map 'default' to {server.endpoint})"
        epoch, report = client.status().epoch, client.sources()
        assert re.fullmatch(
            rf"ServerStatus\(map 'default': \d+ scans, 100 % learnt; epoch {epoch}\)",
            repr(client.status()),
        )
        results: list[object] = [client.metrics(), report, *report.sources.values()]
        results += [client.status().fit, client.changes(1), client.flush(), client.reset()]
        results += [client.download_map(tmp_path / "map.triquad"), synced.report]
        for result in results:
            assert len(repr(result)) < 300
            assert "\n" not in repr(result)
        mesh: Mesh = client.mesh(BOX)
        assert repr(mesh).endswith(f"epoch {mesh.epoch})")
    assert repr(client).endswith(", closed)")
    assert repr(server).endswith(", stopped)")
