"""Nodes of ROS 2 that listen to what a server publishes, byte by byte as over Zenoh."""

import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from support.ros.ros_messages import RosMessages
from support.servers import WAIT_S, raw_session
from triquad_client import MeshWatch

MARKER = "visualization_msgs/msg/Marker"
GRID = "nav_msgs/msg/OccupancyGrid"


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
        return self._samples.get(timeout=WAIT_S)

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
    with raw_session(connect=endpoint) as session:
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
