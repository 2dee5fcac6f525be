"""What RViz, Nav2 and others get of a map: markers and occupancy grids."""

import queue
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import triquad_client
import zenoh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from support import servers
from support.poses import shifted
from support.ros.ros_bridge import bridging
from support.ros.ros_robot import robot
from support.ros_messages import RosMessages
from triquad_client import Client, MeshWatch, Status
from triquad_server.settings import MeshSettings
from triquad_tools.commands import ros2
from triquad_tools.ros2 import bridge
from triquad_tools.ros2.intake.scan_publisher import Place
from triquad_tools.ros2.output.mesh_publisher import MeshPublisher
from triquad_tools.ros2.topics import End, read_token
from triquad_tools.work.ros2 import bridge_options

MARKER = "visualization_msgs/msg/Marker"
GRID = "nav_msgs/msg/OccupancyGrid"
HEIGHT_M = 0.7
SOME_POINTS = 300  # of a tile that holds more than a corner of the surface
WAYS = ["rmw", "humble", "bridge"]


class Listener:
    """A subscription to one topic, whose messages are decoded with rosbags."""

    def __init__(self, session: zenoh.Session, key: str, type_name: str, token: str) -> None:
        self._types = RosMessages().types
        self._type_name = type_name
        self._samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.FifoChannel(1000))
        self._token = session.liveliness().declare_token(token)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._subscriber.undeclare()
        self._thread.join()

    def sample(self) -> zenoh.Sample:
        return self._samples.get(timeout=servers.WAIT_S)

    def message(self) -> Any:
        return self._types.deserialize_cdr(self.sample().payload.to_bytes(), self._type_name)

    def _run(self) -> None:
        for sample in self._subscriber:
            self._samples.put(sample)


@contextmanager
def listening(endpoint: str, topic: str, type_name: str, way: str = "rmw") -> Iterator[Listener]:
    """Listen as a node of rmw_zenoh does, of ROS 2 ``humble`` or a later one, or as a bridge."""
    package, _, name = type_name.split("/")
    dds = f"{package}::msg::dds_::{name}_"
    hash_ = RosMessages().types.hash_rihs01(type_name) if way == "rmw" else "TypeHashNotSupported"
    with servers.raw_session(connect=endpoint) as session:
        key = f"0{topic}/{dds}/{hash_}"
        lives = (
            f"@ros2_lv/0/{session.zid()}/0/5/MS/%/%/rviz/{topic.replace('/', '%')}/{dds}/{hash_}/"
            "::,10:,:,:,,"
        )
        if way == "bridge":
            key = topic.lstrip("/")
            type_key = type_name.replace("/", "§")
            lives = f"@/{session.zid()}/@ros2_lv/MS/{key.replace('/', '§')}/{type_key}/:1:0:0,5"
        listener = Listener(session, key, type_name, lives)
        try:
            yield listener
        finally:
            listener.close()


class ShownMarkers:
    """What RViz shows after some markers."""

    def __init__(self) -> None:
        self.triangles: dict[int, NDArray[np.float64]] = {}

    def take(self, marker: Any) -> None:
        if marker.action == marker.DELETEALL:
            self.triangles.clear()
        elif marker.action == marker.DELETE:
            self.triangles.pop(marker.id, None)
        else:
            assert marker.type == marker.TRIANGLE_LIST
            assert len(marker.points) == len(marker.colors) > 0
            points = np.array([[p.x, p.y, p.z] for p in marker.points])
            self.triangles[marker.id] = points.reshape(-1, 3, 3)

    def shows(self, mesh: MeshWatch) -> bool:
        """Whether these are the triangles of the mesh that a client follows."""
        wanted = [(t.origin + t.vertices)[t.faces] for t in mesh.tiles.values()]
        corners = np.concatenate([np.empty((0, 3, 3)), *wanted])
        shown = np.concatenate([np.empty((0, 3, 3)), *self.triangles.values()])
        if len(shown) != len(corners):
            return False
        distance, _ = cKDTree(shown.mean(axis=1)).query(corners.mean(axis=1))
        return bool(distance.max(initial=0) < 1e-4)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    settings = servers.SMALL.model_copy(update={"mesh": MeshSettings(tile_cells=16)})
    with servers.running_service(settings) as endpoint:
        yield endpoint


@contextmanager
def shown(server: str) -> Iterator[Client]:
    """A bridge that shows a map of a sphere around the origin, and a client of the map."""
    shape = ("--map-frame", "world", "--grid-side-m", 12, "--grid-height-m", HEIGHT_M)
    mesh = ("--mesh-bytes-per-s", 10**9, "--mesh-level", 0)
    with bridging(server, *shape, *mesh) as bridged:
        servers.learn_all(bridged.client)
        yield bridged.client


@contextmanager
def subscribed(
    session: zenoh.Session, key: str, take: Callable[[zenoh.Sample], object]
) -> Iterator[None]:
    """Have what is put in the same session taken before the put returns."""
    subscriber = session.declare_subscriber(key, zenoh.handlers.Callback(take, indirect=False))
    try:
        yield
    finally:
        subscriber.undeclare()


def shown_once_complete(listener: Listener, client: Client) -> ShownMarkers:
    """What is shown, once it is the mesh that the client follows."""
    markers = ShownMarkers()
    with client.watch_mesh() as watch:
        watch.catch_up(servers.WAIT_S)
    while not markers.shows(watch):
        markers.take(listener.message())
    return markers


@pytest.mark.parametrize("way", WAYS)
def test_markers_show_the_mesh_and_what_changes(server: str, way: str) -> None:
    with shown(server) as client, listening(server, "/triquad/mesh", MARKER, way) as rviz:
        markers = shown_once_complete(rviz, client)
        assert len(markers.triangles) > 8, "a marker each tile"
        client.reset(((0.5, -9, -9), (9, 9, 9)))
        client.settle(servers.WAIT_S)
        with client.watch_mesh() as watch:
            watch.catch_up(servers.WAIT_S)
        changed = 0
        while not markers.shows(watch):
            markers.take(rviz.message())
            changed += 1
        assert changed < len(markers.triangles) + 10, "what did not change is not sent again"
        with listening(server, "/triquad/mesh", MARKER, way) as late:
            shown_once_complete(late, client)


def test_markers_carry_colours_frame_and_what_rmw_zenoh_attaches(server: str) -> None:
    with shown(server), listening(server, "/triquad/mesh", MARKER) as rviz:
        attached = [struct.unpack("<qqB16s", rviz.sample().attachment.to_bytes()) for _ in range(3)]
        assert [number for number, *_ in attached] == [1, 2, 3]
        assert {length for _, _, length, _ in attached} == {16}
        assert len({identity for *_, identity in attached}) == 1
        assert all(stamp_ns > 1_600_000_000 * 10**9 for _, stamp_ns, *_ in attached)
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


def test_grids_say_what_the_map_says(server: str) -> None:
    with shown(server) as client, listening(server, "/triquad/grid", GRID) as nav2:
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


def test_grids_go_with_the_robot(server: str) -> None:
    with (
        shown(server),
        robot(server) as r2,
        listening(server, "/triquad/grid", GRID) as nav2,
    ):
        assert nav2.message().info.origin.position.x == pytest.approx(-6.0)
        r2.tf(0, ("world", "lidar", shifted(x=30.04)))
        r2.cloud(0, servers.sphere())
        while (origin := nav2.message().info.origin.position.x) != pytest.approx(24.0):
            assert origin == pytest.approx(-6.0)


def test_a_mesh_that_nobody_takes_does_not_hold_up_grids(server: str) -> None:
    taken = threading.Event()
    grids: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    options = bridge_options(ros2.parser().parse_args(["--map-frame", "world"]))
    with (
        triquad_client.connect(server) as client,
        servers.raw_session(connect=server) as session,
        # In the session of the bridge, so that what it puts waits for the subscriber.
        subscribed(session, "triquad/mesh", lambda _: taken.wait()),
        subscribed(session, "triquad/grid", grids.put),
        bridge.bridging(session, client, options),
    ):
        try:
            assert grids.get(timeout=servers.WAIT_S)
        finally:
            taken.set()


def test_markers_keep_to_their_rate_however_large_each_is(server: str) -> None:
    sizes: list[int] = []
    publisher: Any = SimpleNamespace(
        is_followed=True,
        has_newcomers=lambda: False,
        put=lambda payload: sizes.append(len(payload)),
    )
    rounds = 0
    with shown(server) as client, closing(MeshPublisher(publisher, client, 0, 1000)) as mesh:
        while len(sizes) < 5:
            mesh.publish(Place("world", np.zeros(3), stamp_ns=0), period_s=0.5)
            rounds += len(sizes) > 1  # the first marker deletes all
    assert sum(sizes[1:-1]) <= rounds * 1000 * 0.5


def test_nodes_and_bridges_find_the_topics_and_their_types(server: str) -> None:
    with shown(server), servers.raw_session(connect=server) as session:
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
