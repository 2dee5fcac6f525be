"""A map file answers as the server that it came from, without one."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import servers
from support.files.checkpoint_folder import map_at, write_checkpoints
from support.poses import shifted
from triquad_client import Client, ClosedError, OfflineMap, RefusedError, open_map
from triquad_client.calls.queries import MapQueries
from triquad_format.errors import MapFileError
from triquad_format.mapfile.writer import write_map

POSE = np.eye(4)
BOX = ((-5.0, -5.0, -1.0), (5.0, 5.0, 1.0))
POINTS = np.random.default_rng(0).uniform(-6, 6, (2000, 3))
ENDS = np.random.default_rng(1).uniform(-6, 6, (200, 3))

Question = Callable[[MapQueries], Any]

QUESTIONS: dict[str, Question] = {
    "query_sdf": lambda view: view.query_sdf(POINTS, gradient=True),
    "query_distance": lambda view: view.query_distance(
        POINTS, 3.0, unknown="obstacle", surface_point=True, unknown_distance=True
    ),
    "query_spheres": lambda view: view.query_spheres(POINTS, 0.3),
    "query_segments": lambda view: view.query_segments(POINTS[:200], ENDS, radius_m=0.1),
    "query_polyline": lambda view: view.query_polyline(0.3 * ENDS[:40], radius_m=0.1),
    "query_rays": lambda view: view.query_rays([0, 0, 0], ENDS),
    "query_ground": lambda view: view.query_ground(POINTS, 5.0),
    "query_grid": lambda view: view.query_grid(BOX, cell_m=0.5),
    "align": lambda view: view.align(servers.sphere(3000), shifted(0.2)),
}
"""One of each kind."""


@dataclass(frozen=True)
class Pair:
    """A server that has learnt a sphere, and its map as a file."""

    client: Client
    path: Path


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    path = tmp_path_factory.mktemp("pair") / "map.triquad"
    with servers.service_and_client() as client:
        for _ in range(3):
            client.publish_scan(servers.sphere(20_000), POSE, stamp_s=1.7e9)
        client.flush(servers.WAIT_S)
        client.settle(servers.WAIT_S)
        client.download_map(path)
        yield Pair(client, path)


@pytest.fixture(scope="module")
def offline(pair: Pair) -> Iterator[OfflineMap]:
    with open_map(pair.path) as offline:
        yield offline


def assert_close(have: Any, want: Any, name: str) -> None:
    """Fail unless 99 % of all numbers are within a millimetre, and of all states equal."""
    assert type(have) is type(want), name
    if hasattr(want, "__dataclass_fields__"):
        for field in want.__dataclass_fields__:
            assert_close(getattr(have, field), getattr(want, field), f"{name}.{field}")
    elif isinstance(want, np.ndarray):
        assert (have.dtype, have.shape) == (want.dtype, want.shape), name
        if want.dtype.kind == "f":
            np.testing.assert_array_equal(np.isnan(have), np.isnan(want), err_msg=name)
            apart = np.abs(have - want)[~np.isnan(want)]
            # Directions turn by more where two surfaces are as near; what a ball does not tell of
            # a pose has a variance of half a turn.
            largest = max(1.0, np.abs(want).max(initial=0.0)) if "covariance" in name else 1.0
            assert np.quantile(apart, 0.99) < (0.02 if "gradient" in name else 1e-3 * largest), name
        else:
            assert np.mean(have == want) > 0.99, name
    elif isinstance(want, float):
        assert have == pytest.approx(want, abs=1e-2), name
    elif want is not None and not isinstance(want, tuple):
        assert have == want, name


def test_every_query_of_a_client_is_compared() -> None:
    assert set(QUESTIONS) == {name for name in dir(MapQueries) if not name.startswith("_")}


@pytest.mark.parametrize("name", QUESTIONS)
def test_the_file_answers_as_the_server(pair: Pair, offline: OfflineMap, name: str) -> None:
    assert_close(QUESTIONS[name](offline), QUESTIONS[name](pair.client), name)


def test_only_its_own_epoch_can_be_asked_for(offline: OfflineMap) -> None:
    here = offline.query_sdf(POINTS, at_epoch=offline.epoch)
    np.testing.assert_array_equal(here.sdf, offline.query_sdf(POINTS).sdf)
    for question in (offline.query_sdf, offline.query_distance):
        with pytest.raises(RefusedError, match=rf"kept is \[{offline.epoch}\]") as refusal:
            question(POINTS, at_epoch=offline.epoch + 1)
        assert refusal.value.code == "epoch_gone"


def test_a_closed_map_says_so(pair: Pair) -> None:
    offline = open_map(pair.path)
    offline.close()
    with pytest.raises(ClosedError):
        offline.query_sdf(POINTS)


def test_of_a_store_the_newest_checkpoint_is_opened(tmp_path: Path) -> None:
    folder = tmp_path / "store" / "site"
    folder.mkdir(parents=True)
    with pytest.raises(MapFileError, match="not a folder of checkpoints"):
        open_map(folder)
    write_checkpoints(folder, (3, 5, 8))
    for path in (folder, folder.parent):
        assert open_map(path).epoch == 8
    want = write_map(map_at(8), tmp_path / "whole.triquad")
    whole, delta = open_map(tmp_path / "whole.triquad"), open_map(folder)
    assert whole.epoch == want.epoch
    assert whole.stamp_ns == 0
    np.testing.assert_array_equal(whole.query_sdf(POINTS).sdf, delta.query_sdf(POINTS).sdf)
