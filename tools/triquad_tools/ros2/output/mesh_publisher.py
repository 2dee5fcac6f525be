"""The mesh as markers of ROS 2: a marker for each tile, and only tiles that changed."""

import logging
import threading
import time
from collections.abc import Callable

import numpy as np
from triquad_client import Client, MeshTile, MeshWatch
from triquad_format.errors import TriquadError

from triquad_tools.ros2.intake.scan_publisher import Place
from triquad_tools.ros2.options import MeshOptions
from triquad_tools.ros2.output.markers import Action, Marker
from triquad_tools.ros2.output.topic_publisher import TopicPublisher

_log = logging.getLogger("triquad_ros2")

_TICK_S = 0.2
_ASK_S = 1.0  # for how long the server may wait for changes
_SEND_S = 1.0  # for how long markers are sent before the server is asked for changes again
_RETRY_S = 5.0  # after an error

TileIndex = tuple[int, int, int]


class MeshPublisher:
    """Follows the mesh of the map while it has subscribers, on a thread of its own."""

    def __init__(
        self,
        publisher: TopicPublisher,
        client: Client,
        options: MeshOptions,
        place: Callable[[], Place | None],
    ) -> None:
        """``place`` returns the frame of the map, None before that is known."""
        self._publisher = publisher
        self._client = client
        self._options = options
        self._place = place
        self._numbers: dict[TileIndex, int] = {}  # of the markers of tiles
        self._free_s = 0.0  # monotonic: when the next marker may be sent
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-mesh")
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(_TICK_S):
            place = self._place()
            if place is None or not self._publisher.is_followed:
                continue
            try:
                with self._client.watch_mesh(level=self._options.level) as watch:
                    self._follow(watch, place.map_frame)
            except Exception:
                _log.exception("the mesh could not be published")
                self._stopping.wait(_RETRY_S)

    def _follow(self, watch: MeshWatch, frame: str) -> None:
        """Publish a mesh from its beginning on, until nobody subscribes any more."""
        self._put(
            Marker(frame, 0, Action.DELETE_ALL)
        )  # a bridge before this one may have left some
        pending: dict[TileIndex, None] = {}  # tiles whose markers are to be sent, in this order
        while self._publisher.is_followed and not self._stopping.is_set():
            if self._publisher.has_newcomers():
                pending.update(dict.fromkeys(watch.tiles))
            try:
                update = watch.next(0.0 if pending else _ASK_S)
            except TriquadError as error:
                _log.warning("the mesh cannot be followed now: %s", error)
                self._stopping.wait(_RETRY_S)
                continue
            if update is not None:
                pending.update(dict.fromkeys((*update.removed, *update.changed)))
            send_until = time.monotonic() + _SEND_S
            while pending and time.monotonic() < send_until and not self._stopping.is_set():
                index = next(iter(pending))
                del pending[index]
                self._put(self._marker(index, watch.tiles.get(index), frame))

    def _marker(self, index: TileIndex, tile: MeshTile | None, frame: str) -> Marker:
        number = self._numbers.setdefault(index, len(self._numbers) + 1)
        if tile is None:
            return Marker(frame, number, Action.DELETE)
        vertices = tile.origin + tile.vertices.astype(np.float64)
        return Marker(frame, number, corners=vertices[tile.faces.ravel()])

    def _put(self, marker: Marker) -> None:
        payload = marker.payload()
        if not self._stopping.wait(max(0.0, self._free_s - time.monotonic())):
            self._publisher.put(payload)
            self._free_s = time.monotonic() + len(payload) / self._options.bytes_per_s
