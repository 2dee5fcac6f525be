"""What the client refuses to send, by name, and what it takes."""

import traceback
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support import servers
from triquad_client import (
    Client,
    Intrinsics,
    InvalidInputError,
    InvalidScanError,
    Pose,
    Status,
    TriquadError,
)


class OfAGraph:
    """What gives no array of itself, as torch does of a tensor that requires a gradient."""

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise RuntimeError("Use tensor.detach().numpy() instead.")


POSE = np.eye(4)
CLOUD = np.ones((10, 3), np.float32)


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with servers.service_and_client() as client:
        yield client


@pytest.mark.parametrize(
    ("points", "text"),
    [
        (np.zeros((0, 3)), "no points"),
        (np.zeros((5, 2)), r"\[5, 2\], not \[N, 3\]"),
        (np.zeros(3), r"\[3\], not \[N, 3\]; a single one is \[\[x, y, z\]\]"),
        (5.0, r"\[\], not \[N, 3\]"),
        (np.zeros((3, 500)), r"\[3, 500\], not .*; is it transposed"),
        (np.zeros((2, 3), complex), "complex128"),
        (np.full((2, 3), "1.5"), r"'1.5' \(<U3\) is not a real number"),
        ([[1, 2, 3], [4, 5]], "points are not"),
        (np.ma.masked_greater(np.arange(6.0).reshape(2, 3), 4), "values are masked: fill them"),
        (
            pd.DataFrame(np.ones((2, 3)), columns=["z", "x", "y"]),
            r"give table\[\['x', 'y', 'z'\]\]",
        ),
        (OfAGraph(), r"points are not .* Use tensor.detach\(\).numpy\(\) instead"),
        (None, "points are not"),
    ],
)
def test_points_that_are_no_scan_are_refused_here(client: Client, points: Any, text: str) -> None:
    with pytest.raises(InvalidScanError, match=text):
        client.publish_scan(points, POSE)


def test_tables_are_taken_by_the_names_of_their_columns(client: Client) -> None:
    table = pd.DataFrame(servers.sphere(50), columns=["x", "y", "z"])
    for good in (table, pd.DataFrame(servers.sphere(50))):
        assert len(client.query_sdf(good)) == 50
    with pytest.raises(InvalidInputError, match="a table with columns"):
        client.query_sdf(table[["y", "x", "z"]])


def test_columns_after_the_third_are_left_out(client: Client) -> None:
    cloud = np.concatenate([servers.sphere(), np.full((len(servers.sphere()), 2), 1e9)], axis=1)
    client.publish_scan(cloud, POSE, source="coloured")
    assert client.flush(servers.WAIT_S).taken == 1
    assert (client.query_sdf(servers.sphere(50)).status == Status.SURFACE).all()


@pytest.mark.parametrize(
    ("question", "name"),
    [
        (lambda client: client.query_sdf(CLOUD, "yes"), "gradient = 'yes'"),
        (lambda client: client.query_sdf(CLOUD, 5), "gradient = 5"),
        (lambda client: client.query_distance(CLOUD, surface_point=None), "surface_point = None"),
        (lambda client: client.query_distance(CLOUD, unknown_distance=1), "unknown_distance = 1"),
        (
            lambda client: client.query_rays((0, 0, 0), CLOUD, 5.0, through_unknown="no"),
            "through_unknown = 'no'",
        ),
        (lambda client: client.download_map("map.triquad", "yes"), "training = 'yes'"),
    ],
)
def test_what_is_neither_true_nor_false_is_refused_here(
    client: Client, question: Callable[[Client], object], name: str
) -> None:
    with pytest.raises(InvalidInputError, match=f"{name}: use True or False"):
        question(client)


@pytest.mark.parametrize(
    ("question", "text"),
    [
        (lambda client: client.query_distance(CLOUD, True), "max_distance_m = True is not a n"),
        (lambda client: client.flush(True), "timeout_s = True is not a number"),
        (lambda client: client.sources(max_points=True), "max_points = True is not a whole n"),
        (lambda client: client.sources(max_points=1.0), "max_points = 1.0 is not a whole number"),
        (lambda client: client.query_distance(CLOUD, unknown="no"), "unknown = 'no': use one of"),
        (lambda client: client.query_spheres(CLOUD, 0.1).free("no"), "unknown = 'no': use one of"),
    ],
)
def test_values_of_another_kind_are_refused_here(
    client: Client, question: Callable[[Client], object], text: str
) -> None:
    with pytest.raises(InvalidInputError, match=text):
        question(client)


def test_whole_numbers_of_numpy_are_taken(client: Client) -> None:
    assert list(client.sources(max_points=np.int64(5)).sources) == list(client.sources().sources)


def test_truth_values_of_numpy_are_taken(client: Client) -> None:
    assert client.query_sdf(CLOUD, gradient=np.bool_(True)).gradient.shape == CLOUD.shape


@pytest.mark.parametrize(
    ("pose", "text"),
    [
        (np.eye(3), r"\[3, 3\], not \[4, 4\]"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.diag([2.0, 2, 2, 1]), "not rigid"),
        (np.diag([1.0, 1, -1, 1]), "not rigid"),
        (np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1.0]]), "transposed"),
        ("pose", "not a matrix"),
        (np.full((4, 4), 10**400).tolist(), "not a matrix"),
    ],
)
def test_poses_that_are_not_rigid_are_refused_here(client: Client, pose: Any, text: str) -> None:
    with pytest.raises(InvalidScanError, match=text):
        client.publish_scan(CLOUD, pose)


@pytest.mark.parametrize("stamp", [np.nan, np.inf, -1.0, 1e30, 10**400, "now"])
def test_stamps_that_are_no_time_are_refused_here(client: Client, stamp: Any) -> None:
    with pytest.raises(InvalidScanError, match="stamp_s = "):
        client.publish_scan(CLOUD, POSE, stamp)


@pytest.mark.parametrize("stamp", [1.7e12, 1_700_000_000_000_000_000])
def test_stamps_of_milliseconds_or_nanoseconds_are_told(client: Client, stamp: float) -> None:
    with pytest.raises(InvalidScanError, match="milliseconds, or nanoseconds"):
        client.publish_scan(CLOUD, POSE, stamp)


def test_time_that_runs_backwards_is_refused_here_per_source(client: Client) -> None:
    client.publish_scan(servers.sphere(10), POSE, 1000.5, "a")
    client.publish_scan(servers.sphere(10), POSE, 1000.5, "a")
    client.publish_scan(servers.sphere(10), POSE, 10.0, "b")
    with pytest.raises(InvalidScanError, match="in order"):
        client.publish_scan(CLOUD, POSE, 1000.4, "a")
    before = client.flush(servers.WAIT_S)
    client.restart_source("a")
    client.publish_scan(servers.sphere(10), POSE, 3.0, "a")
    after = client.flush(servers.WAIT_S)
    assert (after.taken, after.lost) == (before.taken - 2 + 1, before.lost), "a began again"


@pytest.mark.parametrize("source", ["a/b", "", None, 3])
def test_sources_that_are_no_names_are_refused_here(client: Client, source: Any) -> None:
    with pytest.raises(InvalidScanError, match=f"source name {source!r} .* use a text of 1 to 64"):
        client.publish_scan(CLOUD, POSE, source=source)


def test_lists_and_other_numbers_are_taken(client: Client) -> None:
    taken = client.flush(servers.WAIT_S).taken
    client.publish_scan(servers.sphere(100).tolist(), np.eye(4, dtype=int).tolist())
    client.publish_scan(np.asfortranarray(servers.sphere(100).astype(np.float64))[::-1], POSE)
    client.publish_scan((100 * servers.sphere(100)).astype(np.int16) // 100, POSE)
    report = client.flush(servers.WAIT_S)
    assert (report.taken - taken, report.lost) == (3, 0)
    assert client.query_sdf([[0, 0, 0], [1, 2, 3]]).sdf.shape == (2,)


def test_points_that_are_not_finite_are_refused_by_index(client: Client) -> None:
    points = np.zeros((5, 3))
    points[3, 1] = np.nan
    with pytest.raises(InvalidInputError, match="point 3 is not finite"):
        client.query_sdf(points)
    with pytest.raises(InvalidInputError, match="point 1 is .* metres of the map frame"):
        client.query_sdf([[0, 0, 0], [0, 2e9, 0]])
    with pytest.raises(ValueError, match="not finite"):
        client.query_sdf([[np.inf, 0, 0]], gradient=True)


@pytest.mark.parametrize(
    "bounds",
    [
        ((0, 0), (1, 1)),
        ((1, 0, 0), (0, 1, 1)),
        ((np.nan, 0, 0), (1, 1, 1)),
        ((0, 0, 0), (1, 1, 10**400)),
        (1, 2, 3),
        5,
    ],
)
def test_bounds_that_are_no_box_are_refused_here(client: Client, bounds: Any) -> None:
    with pytest.raises(InvalidInputError, match="bounds"):
        client.mesh(bounds)


@pytest.mark.parametrize(
    ("timeout_s", "pending", "text"),
    [
        (-1.0, 0, "timeout_s = -1.0: use 0 to 1e\\+06"),
        (1.0, -1, "pending = -1: use 0"),
        (10**400, 0, "timeout_s = 1000.*000: use 0 to"),
        ("long", 0, "timeout_s = 'long' is not a number"),
    ],
)
def test_a_flush_that_cannot_be_waited_for_is_refused_here(
    client: Client, timeout_s: Any, pending: int, text: str
) -> None:
    with pytest.raises(InvalidInputError, match=text):
        client.flush(timeout_s, pending)


TEXTS = np.full((3, 3), "1.5")
OF_CLIENTS: dict[str, Callable[[Client], object]] = {
    "timeout_s": lambda client: client.flush("1.5"),  # type: ignore[arg-type]
    "pending": lambda client: client.flush(1.5, "1"),  # type: ignore[arg-type]
    "stamp_s": lambda client: client.publish_scan(CLOUD, POSE, "1.5"),  # type: ignore[arg-type]
    "world_from_sensor": lambda client: client.publish_scan(CLOUD, POSE.astype(str)),
    "position_m": lambda client: client.publish_scan(CLOUD, Pose(["1.5", 0, 0], (0, 0, 0, 1))),
    "no_return": lambda client: client.publish_scan(CLOUD, POSE, no_return=TEXTS),
    "camera matrix": lambda client: client.publish_depth(CLOUD, TEXTS, POSE),
    "intrinsics": lambda _: Intrinsics("1.5", 1, 1, 1),  # type: ignore[arg-type]
    "points": lambda client: client.query_sdf(TEXTS),
    "max_distance_m": lambda client: client.query_distance(CLOUD, "1.5"),  # type: ignore[arg-type]
    "radii_m": lambda client: client.query_spheres(CLOUD, "1.5"),
    "cell_m": lambda client: client.query_grid(((0, 0, 0), (1, 1, 1)), "1.5"),  # type: ignore[arg-type]
    "bounds": lambda client: client.mesh((["1.5", "0", "0"], [2, 2, 2])),  # type: ignore[list-item]
    "max_points": lambda client: client.sources(None, "1"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("name", OF_CLIENTS)
def test_numbers_as_text_are_refused_with_their_name_and_value(client: Client, name: str) -> None:
    with pytest.raises(InvalidInputError, match=f"{name}[^1]*.*'1(.[05])?'"):
        OF_CLIENTS[name](client)


@pytest.mark.parametrize(
    "fails", [OF_CLIENTS["max_distance_m"], lambda client: client.query_sdf(CLOUD, at_epoch=9**9)]
)
def test_an_error_has_no_trace_of_what_is_within(
    client: Client, fails: Callable[[Client], object]
) -> None:
    with pytest.raises(TriquadError) as caught:
        fails(client)
    names = [frame.name for frame in traceback.extract_tb(caught.value.__traceback__)]
    assert names == ["test_an_error_has_no_trace_of_what_is_within", "<lambda>", "call"]
    assert caught.value.__suppress_context__
