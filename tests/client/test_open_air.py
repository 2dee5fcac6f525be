"""Rays that met nothing, from the client to what the map answers."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import triquad_client
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from support import servers
from triquad_client import Client, InvalidScanError, Status
from triquad_server.settings import Settings

POSE = np.eye(4)
UP = [[0.0, 0.0, 1.0]]
NOTHING = np.empty((0, 3))
GLASS_M = 6.0


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with servers.running_service() as endpoint:
        yield endpoint


def open_settings(**sources: dict[str, object]) -> Settings:
    return Settings.model_validate(servers.SMALL.model_dump() | {"sources": sources})


def statuses(client: Client, points: ArrayLike) -> list[Status]:
    client.flush(servers.WAIT_S)
    return [Status(status) for status in client.query_sdf(points).status]


def wall(distance_m: float) -> np.ndarray:
    """Points [N, 3] of a wall in front of the sensor."""
    y, z = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41))
    return np.stack([np.full(y.size, distance_m), y.ravel(), z.ravel()], axis=1)


def test_a_scan_of_which_no_ray_returned_shows_open_air_and_nothing_else() -> None:
    with servers.service_and_client() as client:
        client.publish_scan(NOTHING, POSE, no_return=[[0, 0, 5], [0, 1e-200, 0]])
        assert client.flush(servers.WAIT_S).taken == 1
        up = [[0.0, 0, z] for z in (0.1, 1, 5, 10)]
        assert statuses(client, up) == [Status.FREE] * 4
        assert statuses(client, [[0, 3, 0], [0, -3, 0], [3, 0, 0]]) == [
            Status.FREE,
            Status.UNKNOWN,
            Status.UNKNOWN,
        ]
        status = client.status()
        assert (status.rays_kept, status.regions) == (0, 1), "nothing to learn, no far region"
        assert client.mesh().faces.shape == (0, 3)


def test_a_source_that_is_not_believed_shows_nothing() -> None:
    with servers.service_and_client(open_settings(glassy={"no_return": False})) as client:
        client.publish_scan(wall(3.0), POSE, source="glassy", no_return=UP)
        client.publish_scan(NOTHING, POSE, source="glassy", no_return=UP)
        report = client.flush(servers.WAIT_S)
        assert (report.taken, report.refused) == (1, 1)
        assert report.last_refusal is not None
        assert "1 rays without a return are not believed" in report.last_refusal
        assert "no_return = false" in report.last_refusal
        assert client.status().points_dropped == {"no_return": 1}
        assert statuses(client, [[0, 0, 3], [2, 0, 0]]) == [Status.UNKNOWN, Status.FREE]


def test_surfaces_stay_where_later_rays_return_nothing() -> None:
    with servers.service_and_client() as client:
        client.publish_scan(wall(GLASS_M), POSE)
        client.settle()
        before = client.query_sdf(wall(GLASS_M))
        assert (before.status == Status.SURFACE).all()
        for _ in range(20):
            client.publish_scan(NOTHING, POSE, no_return=wall(GLASS_M))
        client.flush(servers.WAIT_S)
        after = client.query_sdf(wall(GLASS_M))
        assert (after.status == Status.SURFACE).all()
        np.testing.assert_array_equal(after.sdf, before.sdf)
        assert statuses(client, [[9.0, 0, 0]]) == [Status.FREE], "what lies behind was crossed"


def test_points_beyond_the_range_and_none_show_the_space_up_to_it() -> None:
    with servers.service_and_client(open_settings(short={"range_max_m": 8.0})) as client:
        near = [[3, 0, 0], [3, 0.1, 0], [3, 0, 0.1]]  # a single return were no surface yet
        points, no_return = [[0, 0, 9], [0, 3e30, 0], *near], [[0, -1, 0]]
        client.publish_scan(points, POSE, source="short", no_return=no_return)
        asked = [[0, 0, 7.9], [0, 0, 8.5], [0, 7.9, 0], [3, 0, 0], [0, -7.9, 0], [0, -8.5, 0]]
        expected = [Status.FREE, Status.UNKNOWN, Status.FREE, Status.SURFACE]
        assert statuses(client, asked) == [*expected, Status.FREE, Status.UNKNOWN]
        assert client.status().points_dropped == {"too_far": 2}


def test_the_robot_is_free_and_no_surface() -> None:
    box = ((-1.0, -0.6, -0.4), (2.0, 0.6, 0.4))
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.3, 0.9]).as_matrix()
    turned[:3, 3] = 4.05, 1.05, 0.05
    settings = open_settings(roof={"robot_box_m": box, "range_min_m": 0.0})
    with servers.service_and_client(settings) as client:
        hood = [[1.8, 0.3, 0.2], [1.9, -0.3, 0.1]]
        client.publish_scan([*hood, [6.0, 0, 0]], turned, source="roof")
        grid = np.stack(np.meshgrid(*[np.arange(-25, 26) * 0.1] * 3), -1).reshape(-1, 3)
        inside = ((grid > np.add(box[0], 0.2)) & (grid < np.subtract(box[1], 0.2))).all(axis=1)
        outside = ((grid < np.subtract(box[0], 0.2)) | (grid > np.add(box[1], 0.2))).any(axis=1)
        outside &= np.abs(grid[:, 1:]).max(axis=1) > 0.3  # not on the one ray
        world = grid @ turned[:3, :3].T + turned[:3, 3]
        client.flush(servers.WAIT_S)
        assert (client.query_sdf(world[inside]).status == Status.FREE).all()
        assert (client.query_sdf(world[outside]).status == Status.UNKNOWN).all()
        assert client.status().points_dropped == {"on_robot": 2}


def test_where_the_robot_drove_surfaces_stay() -> None:
    settings = open_settings(roof={"robot_box_m": ((-1, -1, -1), (1, 1, 1))})
    with servers.service_and_client(settings) as client:
        client.publish_scan(wall(3.0), POSE)
        at_wall = POSE.copy()
        at_wall[0, 3] = 3.0
        client.publish_scan(wall(3.0), at_wall, source="roof")
        assert statuses(client, [[3.0, 0, 0], [2.5, 0.5, 0.5], [3.5, 0.5, 0.5]]) == [
            Status.SURFACE,
            Status.FREE,
            Status.FREE,
        ]


@pytest.mark.parametrize(
    ("no_return", "text"),
    [
        ([[0, 0, 1], [0, 0, 0]], "direction 1 of no_return is .*has a length"),
        ([[0, 0, 1], [0, 1, 0], [0, np.nan, 1]], "direction 2 of no_return .*finite"),
        ([[np.inf, 0, 0]], "direction 0 of no_return .*finite"),
        (np.zeros((5, 2)), r"no_return are \[5, 2\], not \[N, 3\]"),
        (np.zeros((2, 2, 3)), r"no_return are \[2, 2, 3\]"),
        ("up", "no_return are not an array"),
        (NOTHING, "no points"),
        (None, "no points"),
    ],
)
def test_what_is_no_direction_is_refused_here(endpoint: str, no_return: Any, text: str) -> None:
    with (
        triquad_client.connect(endpoint) as client,
        pytest.raises(InvalidScanError, match=text),
    ):
        client.publish_scan(NOTHING, POSE, no_return=no_return)


def test_an_organised_cloud_tells_its_empty_returns() -> None:
    azimuth = np.radians(np.arange(0, 360, 5))
    elevation = np.radians([[-10.0], [60.0]])
    flat = np.cos(elevation)
    rays = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1
    )
    cloud = 4.0 * rays
    cloud[1] = np.nan
    cloud[0, 2] = 0
    empty = triquad_client.empty_returns(cloud, rays)
    np.testing.assert_array_equal(empty, [rays[0, 2], *rays[1]])
    with servers.service_and_client() as client:
        client.publish_scan(cloud.reshape(-1, 3), POSE, no_return=empty)
        asked = [4.0 * rays[0, 0], 2.0 * rays[0, 0], 6.0 * rays[0, 2], 6.0 * rays[1, 3]]
        free = [Status.FREE] * 3
        assert statuses(client, asked) == [Status.SURFACE, *free]


@pytest.mark.parametrize(
    ("cloud", "directions", "text"),
    [
        (np.zeros((6, 3)), np.zeros((6, 3)), r"cloud: \[6, 3\] is not \[rows, columns, 3\]"),
        (np.zeros((2, 6, 3)), np.zeros((6, 2, 3)), r"cloud is \[2, 6, 3\] and directions are"),
        (np.zeros((2, 6, 3)), "up", "directions: not an array"),
        (np.zeros((2, 6, 3)), np.full((2, 6, 3), 10**400).tolist(), "directions: not an array"),
        (np.zeros((2, 6, 3)), np.full((2, 6, 3), "1"), "directions: not an array"),
    ],
)
def test_clouds_and_directions_that_do_not_fit_are_refused(
    cloud: Any, directions: Any, text: str
) -> None:
    with pytest.raises(InvalidScanError, match=text):
        triquad_client.empty_returns(cloud, directions)
