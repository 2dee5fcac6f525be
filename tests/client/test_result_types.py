"""What was asked for is there, of both clients and for type checkers: mypy checks this file.

Words that do not exist are errors twice over: mypy tells where such a comment is not needed.
"""

import asyncio
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import triquad_client
import triquad_server
from numpy.typing import NDArray
from triquad_client import (
    AsyncClient,
    AsyncPinnedMap,
    AsyncSyncedMap,
    Distances,
    MapQueries,
    NotAskedError,
    SdfResult,
    Unknown,
)
from triquad_map.questions.distance import UnknownLike

POINTS = np.zeros((3, 3))
BOX = ((-10.0, -10.0, -10.0), (10.0, 10.0, 10.0))


@pytest.fixture(scope="module")
def server() -> Iterator[triquad_server.Server]:
    with triquad_server.serve() as server:
        with server.client() as client:
            rays = np.random.default_rng(0).normal(size=(2000, 3))
            client.publish_scan(5 * rays / np.linalg.norm(rays, axis=1, keepdims=True), np.eye(4))
            client.flush()
        yield server


def check_sdf(answer: SdfResult, plain: SdfResult) -> None:
    """``answer`` has what ``plain`` was not asked for."""
    gradient: NDArray[np.float32] = answer.gradient
    assert gradient.shape == (3, 3)
    with pytest.raises(NotAskedError, match="give the query gradient=True"):
        _ = plain.gradient
    assert not hasattr(plain, "gradient")
    assert "3 points" in repr(plain)


def check_distances(answer: Distances, plain: Distances) -> None:
    """As :func:`check_sdf`."""
    surface_point: NDArray[np.float64] = answer.surface_point
    unknown_distance_m: NDArray[np.float32] = answer.unknown_distance_m
    unknown_point: NDArray[np.float64] = answer.unknown_point
    assert surface_point.shape == unknown_point.shape == (3, 3)
    assert unknown_distance_m.shape == (3,)
    with pytest.raises(NotAskedError, match="give the query surface_point=True"):
        _ = plain.surface_point
    with pytest.raises(NotAskedError, match="give the query unknown_distance=True"):
        _ = plain.unknown_distance_m
    with pytest.raises(NotAskedError, match="give the query unknown_distance=True"):
        _ = plain.unknown_point


def ask(queries: MapQueries) -> None:
    check_sdf(queries.query_sdf(POINTS, gradient=True), queries.query_sdf(POINTS))
    check_distances(
        queries.query_distance(POINTS, surface_point=True, unknown_distance=True),
        queries.query_distance(POINTS, unknown="free"),
    )


def test_whoever_asks_has_it(server: triquad_server.Server, tmp_path: Path) -> None:
    path = tmp_path / "map.triquad"
    with server.client() as client:
        ask(client)
        ask(client.pinned())
        ask(client.sync(BOX, path))
        ask(triquad_client.open_map(path))


async def ask_async(queries: AsyncClient | AsyncPinnedMap | AsyncSyncedMap) -> None:
    check_sdf(await queries.query_sdf(POINTS, gradient=True), await queries.query_sdf(POINTS))
    check_distances(
        await queries.query_distance(POINTS, surface_point=True, unknown_distance=True),
        await queries.query_distance(POINTS, unknown="free"),
    )


def test_who_awaits_it_has_it_too(server: triquad_server.Server, tmp_path: Path) -> None:
    async def ask_all() -> None:
        async with triquad_client.connect_async(server.endpoint) as client:
            await ask_async(client)
            await ask_async(await client.pinned())
            await ask_async(await client.sync(BOX, tmp_path / "map.triquad"))

    asyncio.run(ask_all())


def test_the_words_for_unknown_space_are_known_and_no_others(server: triquad_server.Server) -> None:
    _, words = get_args(UnknownLike)
    assert set(get_args(words)) == {way.value for way in Unknown}
    with server.client() as client:
        client.query_distance(POINTS, unknown="obstacle")
        spheres = client.query_spheres(POINTS, 0.1)
        segments = client.query_segments(POINTS, POINTS + 1.0)
        way = client.query_polyline(POINTS)
        spheres.free("free"), segments.free("obstacle"), way.free(Unknown.FREE)
        with pytest.raises(triquad_client.InvalidInputError, match="unknown = 'wall'"):
            client.query_distance(POINTS, unknown="wall")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="wall"):
            spheres.free("wall")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="wall"):
            segments.free("wall")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="wall"):
            way.free("wall")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("blocking", "awaited"),
    [
        (triquad_client.Client, AsyncClient),
        (triquad_client.PinnedMap, AsyncPinnedMap),
        (triquad_client.SyncedMap, AsyncSyncedMap),
        (triquad_client.MeshWatch, triquad_client.AsyncMeshWatch),
    ],
)
def test_both_clients_are_asked_alike(blocking: type, awaited: type) -> None:
    def methods(kind: type) -> dict[str, list[tuple[str, object]]]:
        return {
            name: [(one.name, one.default) for one in inspect.signature(method).parameters.values()]
            for name, method in inspect.getmembers(kind, inspect.isfunction)
            if not name.startswith("_")
        }

    assert methods(awaited) == methods(blocking)
    assert all(inspect.getdoc(getattr(awaited, name)) for name in methods(awaited))
