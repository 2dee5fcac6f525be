"""What RViz, Nav2 and others get of a map: markers and occupancy grids."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import triquad_client
from support import servers
from support.ros_listener import GRID, MARKER, Listener, ShownMarkers, listening
from support.ros_robot import robot, shifted
from triquad_client import Client, Status
from triquad_server.ros2.topics import End, read_token
from triquad_server.settings import MeshSettings, Ros2Settings

HEIGHT_M = 0.7
SOME_POINTS = 300  # of a tile that holds more than a corner of the surface
WAYS = ["rmw", "humble", "bridge"]


@contextmanager
def serving(**changes: object) -> Iterator[tuple[str, Client]]:
    """A server with a map of a sphere around the origin, and a client of it."""
    ros2 = Ros2Settings(
        **{
            "enabled": True,
            "map_frame": "world",
            "grid_side_m": 12.0,
            "grid_height_m": HEIGHT_M,
            "mesh_bytes_per_s": 10**9,
            "mesh_level": 0,
            **changes,
        }
    )
    settings = servers.SMALL.model_copy(update={"ros2": ros2, "mesh": MeshSettings(tile_cells=16)})
    with (
        servers.running_service(settings) as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        servers.learn(client)
        client.settle(servers.WAIT_S)
        yield endpoint, client


def shown_once_complete(listener: Listener, client: Client) -> ShownMarkers:
    """What is shown, once it is the mesh that the client follows."""
    shown = ShownMarkers()
    with client.watch_mesh() as watch:
        watch.catch_up(servers.WAIT_S)
    while not shown.shows(watch):
        shown.take(listener.message())
    return shown


@pytest.mark.parametrize("way", WAYS)
def test_markers_show_the_mesh_and_what_changes(way: str) -> None:
    with serving() as (endpoint, client), listening(endpoint, "/triquad/mesh", MARKER, way) as rviz:
        shown = shown_once_complete(rviz, client)
        assert len(shown.triangles) > 8, "a marker each tile"
        client.reset(((0.5, -9, -9), (9, 9, 9)))
        client.settle(servers.WAIT_S)
        with client.watch_mesh() as watch:
            watch.catch_up(servers.WAIT_S)
        changed = 0
        while not shown.shows(watch):
            shown.take(rviz.message())
            changed += 1
        assert changed < len(shown.triangles) + 10, "what did not change is not sent again"


@pytest.mark.parametrize("token", [True, False])
def test_whoever_listens_late_gets_the_whole_mesh(token: bool) -> None:
    with serving() as (endpoint, client):
        for _ in range(2):
            with listening(endpoint, "/triquad/mesh", MARKER, token=token) as rviz:
                shown_once_complete(rviz, client)
        with (
            listening(endpoint, "/triquad/mesh", MARKER) as first,
            listening(endpoint, "/triquad/mesh", MARKER) as second,
        ):
            shown_once_complete(first, client)
            shown_once_complete(second, client)


def test_markers_are_coloured_by_height_in_the_frame_of_the_map() -> None:
    with serving() as (endpoint, _), listening(endpoint, "/triquad/mesh", MARKER) as rviz:
        while len((marker := rviz.message()).points) < SOME_POINTS:
            assert marker.points or marker.action == marker.DELETEALL
        assert (marker.header.frame_id, marker.ns) == ("world", "triquad")
        assert (marker.pose.orientation.w, marker.scale.x, marker.color.a) == (1, 1, 1)
        heights = np.array([point.z for point in marker.points])
        colours = np.array([[c.r, c.g, c.b, c.a] for c in marker.colors])
        assert (colours >= 0).all()
        assert (colours <= 1).all()
        assert (colours[:, 3] == 1).all()
        order = np.argsort(heights)
        assert np.abs(np.diff(colours[order], axis=0)).max() < 0.3
        assert np.ptp(colours, axis=0).max() > 0.01


@pytest.mark.parametrize("way", WAYS)
def test_grids_say_what_the_map_says(way: str) -> None:
    with serving() as (endpoint, client), listening(endpoint, "/triquad/grid", GRID, way) as nav2:
        grid = nav2.message()
        assert (grid.info.width, grid.info.height) == (120, 120)
        assert grid.info.resolution == pytest.approx(0.1)
        assert grid.header.frame_id == "world"
        origin = np.array([grid.info.origin.position.x, grid.info.origin.position.y])
        values = grid.data.reshape(120, 120)
        cells = np.indices((120, 120))[::-1].reshape(2, -1).T  # x, y of each in its order
        points = np.column_stack([origin + (cells + 0.5) * 0.1, np.full(len(cells), HEIGHT_M)])
        answer = client.query_distance(points, max_distance_m=0.1)
        values = values.reshape(-1)
        is_near = np.abs(answer.distance_m) < 0.04
        assert (values[is_near] == 100).all()
        assert is_near.sum() > 100
        is_free = (answer.status == Status.FREE) & (answer.distance_m > 0.06)
        assert (values[is_free] == 0).all()
        assert is_free.sum() > 1000
        is_unknown = (answer.status == Status.UNKNOWN) & (np.abs(answer.distance_m) > 0.06)
        assert (values[is_unknown] == -1).all()
        assert is_unknown.sum() > 1000


def test_grids_go_with_the_robot() -> None:
    with (
        serving(grid_period_s=0.1) as (endpoint, _),
        robot(endpoint) as r2,
        listening(endpoint, "/triquad/grid", GRID) as nav2,
    ):
        assert nav2.message().info.origin.position.x == pytest.approx(-6.0)
        r2.tf(0, ("world", "lidar", shifted(x=30.04)))
        r2.cloud(0, servers.sphere())
        while (origin := nav2.message().info.origin.position.x) != pytest.approx(24.0):
            assert origin == pytest.approx(-6.0)


def test_messages_carry_what_rmw_zenoh_attaches() -> None:
    with serving() as (endpoint, _), listening(endpoint, "/triquad/mesh", MARKER) as rviz:
        numbers, identities = [], set()
        for _ in range(3):
            attachment = rviz.sample().attachment.to_bytes()
            assert len(attachment) == 33
            number, stamp_ns, length = struct.unpack_from("<qqB", attachment)
            assert stamp_ns > 1_600_000_000 * 10**9
            assert length == 16
            numbers.append(number)
            identities.add(attachment[17:])
        assert numbers == [1, 2, 3]
        assert len(identities) == 1


def test_nodes_and_bridges_find_the_topics_and_their_types() -> None:
    with serving() as (endpoint, _), servers.raw_session(connect=endpoint) as session:
        tokens = [
            str(reply.ok.key_expr)
            for key in ("@ros2_lv/**", "@/*/@ros2_lv/**")
            for reply in session.liveliness().get(key, timeout=servers.WAIT_S)
        ]
        node = next(token for token in tokens if "/NN/" in token)
        assert node.split("/")[5:] == ["NN", "%", "%", "triquad"]
        found = [each for each in map(read_token, tokens) if each]
        assert all(each.end is End.PUBLISHER for each in found)
        names = sorted((each.topic.name, each.topic.type_name) for each in found)
        assert names == 2 * [("/triquad/grid", GRID)] + 2 * [("/triquad/mesh", MARKER)]
        grid = next(token for token in tokens if "%triquad%grid" in token)
        assert grid.rpartition("/")[2] == ":1:,1:,:,:,,"


def test_topics_without_a_name_are_not_published() -> None:
    with (
        serving(mesh_topic="", grid_topic="") as (endpoint, _),
        servers.raw_session(connect=endpoint) as session,
    ):
        tokens = session.liveliness().get("@ros2_lv/*/*/*/*/MP/**", timeout=servers.WAIT_S)
        assert [str(reply.ok.key_expr) for reply in tokens] == []
