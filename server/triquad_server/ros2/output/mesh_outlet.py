"""The mesh as markers of ROS 2: a marker a tile, and only tiles that changed."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.wire.messages import TileUpdates, TileUpdatesRequest
from triquad_format.wire.tile_codec import decode_tile
from triquad_map.compiled.priority import lower_priority

from triquad_server.fair_queue import Owner
from triquad_server.mesh.mesher import TileIndex
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.process.threads import NICENESS
from triquad_server.ros2.intake.scans import Place
from triquad_server.ros2.output.markers import Action, Marker
from triquad_server.ros2.output.outlet import Outlet

_log = logging.getLogger("triquad_server.ros2")

_TICK_S = 0.2
_ASK_S = 1.0  # so long a request for tiles may wait
_REPLY_BYTES = 100_000  # of encoded tiles, which are some fifty times larger as markers
_CLIENT = "ros2"


class _Request:
    """A request for tiles from this process; whoever answers it does not see the difference."""

    def __init__(self, asks: TileUpdatesRequest) -> None:
        self._asks = asks
        self.reply: queue.SimpleQueue[TileUpdates | None] = queue.SimpleQueue()

    @property
    def size(self) -> int:
        """No bytes of a message."""
        return 0

    @property
    def owner(self) -> Owner:
        """Nobody beyond this process."""
        return Owner(_CLIENT)

    def read(self, _kind: type[TileUpdatesRequest]) -> TileUpdatesRequest:
        return self._asks

    def answer(self, message: TileUpdates) -> None:
        self.reply.put(message)

    def refuse(self, code: str, text: str) -> None:
        _log.debug("no tiles for ROS 2 (%s): %s", code, text)
        self.reply.put(None)

    def fail(self, error: Exception) -> None:
        _log.exception("no tiles for ROS 2")
        self.refuse("internal", str(error))


class MeshOutlet:
    """Follows the mesh as any client does, and publishes what it gets, on a thread of its own."""

    def __init__(
        self,
        outlet: Outlet,
        feed: TileFeed,
        *,
        level: int,
        bytes_per_s: int,
        place: Callable[[], Place | None],
    ) -> None:
        self._outlet = outlet
        self._feed = feed
        self._level = level
        self._bytes_per_s = bytes_per_s
        self._place = place
        self._server = ""  # in whose revisions the mesh is known
        self._revision = 0
        self._numbers: dict[TileIndex, int] = {}
        self._is_first = True
        self._free_s = 0.0  # monotonic: when what was sent last is through
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-mesh")
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        lower_priority(NICENESS)
        while not self._stopping.is_set():
            try:
                self._turn()
            except Exception:
                _log.exception("ros2: the mesh could not be published")
                self._stopping.wait(_ASK_S)

    def _turn(self) -> None:
        if self._outlet.has_newcomers():
            self._revision = 0  # they have no tiles: all are sent again
        place = self._place()
        updates = None if place is None or not self._outlet.is_followed else self._ask()
        if place is None or updates is None:
            self._stopping.wait(_TICK_S)
            return
        self._server, self._revision = updates.server, updates.revision
        for marker in self._markers(updates, place.map_frame):
            payload = marker.payload()
            if self._stopping.wait(max(0.0, self._free_s - time.monotonic())):
                return
            self._outlet.put(payload)
            self._free_s = time.monotonic() + len(payload) / self._bytes_per_s

    def _ask(self) -> TileUpdates | None:
        """What changed; None where that cannot be told now."""
        everywhere = np.full(3, np.inf)
        request = _Request(
            TileUpdatesRequest(
                level=self._level,
                minimum=-everywhere,
                maximum=everywhere,
                server=self._server,
                revision=self._revision,
                known=np.empty((0, 3), np.int32),
                known_versions=np.empty(0, np.int64),
                max_bytes=_REPLY_BYTES,
                timeout_s=_ASK_S,
                client=_CLIENT,
                max_bytes_per_s=0,
            )
        )
        try:
            self._feed.add(request)
        except RefusedError as error:
            request.refuse(error.code, error.message)
        return request.reply.get()

    def _markers(self, updates: TileUpdates, frame: str) -> Iterator[Marker]:
        if self._is_first:  # a server before this one may have left some
            self._is_first = False
            yield Marker(frame, 0, Action.DELETE_ALL)
        for index in updates.removed.tolist():
            yield Marker(frame, self._number(tuple(index)), Action.DELETE)
        ends = np.cumsum(updates.sizes)
        for index, size, end in zip(updates.tiles.tolist(), updates.sizes, ends, strict=True):
            surface = decode_tile(updates.data[end - size : end])
            corner = np.array(index) * updates.tile_side_m
            vertices = surface.positions(updates.cell_m) + corner
            number = self._number(tuple(index))
            yield Marker(frame, number, corners=vertices[surface.faces.ravel()])

    def _number(self, index: TileIndex) -> int:
        """The number of a tile's marker."""
        return self._numbers.setdefault(index, len(self._numbers) + 1)
