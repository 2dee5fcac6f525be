"""The mesh as markers of ROS 2: a marker for each tile, and only tiles that changed."""

from dataclasses import dataclass

import numpy as np
from triquad_client import Client, MeshTile, MeshWatch
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.scan_log.ros_messages import CdrWriter

from triquad_tools.ros2.intake.scan_publisher import Place
from triquad_tools.ros2.output.topic_publisher import TopicPublisher

_TRIANGLE_LIST = 11
_NO_CORNERS = np.empty((0, 3))
_NAMESPACE = "triquad"
_COLOURS_REPEAT_M = 10.0
_PHASES = np.array([0.0, 1 / 3, 2 / 3])  # of red, green and blue

TileIndex = tuple[int, int, int]

ADD, DELETE, DELETE_ALL = 0, 2, 3  # the actions of markers; the first one replaces, too


def marker_message(
    frame: str, number: int, action: int = ADD, corners: Doubles = _NO_CORNERS
) -> bytes:
    """Return triangles that are shown, replaced and deleted together, CDR.

    Their ``corners`` [3 F, 3] are metres, map frame.
    """
    writer = CdrWriter().numbers("<u4", 0, 0).text(frame).text(_NAMESPACE)
    writer.numbers("<i4", number, _TRIANGLE_LIST, action)
    writer.numbers("<f8", 0, 0, 0, 0, 0, 0, 1, 1, 1, 1)  # pose and scale
    writer.numbers("<f4", 1, 1, 1, 1).numbers("<u4", 0, 0).numbers("u1", False)
    writer.sequence(corners.astype("<f8")).sequence(height_colours(corners))
    nothing = np.empty(0, np.uint8)  # of texture, text and mesh file
    writer.text("").numbers("<u4", 0, 0).text("").text("").sequence(nothing)
    writer.sequence(nothing).text("").text("")
    return writer.text("").sequence(nothing).numbers("u1", False).payload()


def height_colours(points: Doubles) -> Floats:
    """Return red, green, blue and opacity [N, 4] of points [N, 3]; they repeat after ten metres."""
    turns = points[:, 2:] / _COLOURS_REPEAT_M + _PHASES
    colours = np.ones((len(points), 4), "<f4")
    colours[:, :3] = 0.55 + 0.4 * np.cos(2 * np.pi * turns)
    return colours


@dataclass
class MeshPublisher:
    """Follows the mesh of the map while it has subscribers."""

    publisher: TopicPublisher
    client: Client
    level: int  # of detail
    bytes_per_s: int  # of markers, at most

    def __post_init__(self) -> None:
        self._numbers: dict[TileIndex, int] = {}  # of the markers of tiles
        self._watch: MeshWatch | None = None  # while there are subscribers
        self._pending: dict[TileIndex, None] = {}  # whose markers are to be sent, in this order
        self._left_bytes = 0.0  # that may be sent; below 0 after a marker that was larger

    def publish(self, place: Place, period_s: float) -> None:
        """Send markers of what changed, as many as may be sent in ``period_s``; return soon."""
        self._left_bytes = min(self._left_bytes, 0) + period_s * self.bytes_per_s
        if not self.publisher.is_followed:
            self.close()
            return
        if self._watch is None:
            self._watch = self.client.watch_mesh(level=self.level)
            # A bridge before this one may have left some.
            self.publisher.put(marker_message(place.map_frame, 0, DELETE_ALL))
        if self.publisher.has_newcomers():
            self._pending.update(dict.fromkeys(self._watch.tiles))
        while self._left_bytes > 0:
            if not self._pending:
                update = self._watch.next(timeout_s=0.0)
                if update is None:
                    return
                self._pending.update(dict.fromkeys((*update.removed, *update.changed)))
            index = next(iter(self._pending))
            del self._pending[index]
            payload = self._marker(index, self._watch.tiles.get(index), place.map_frame)
            self.publisher.put(payload)
            self._left_bytes -= len(payload)

    def close(self) -> None:
        """Follow the mesh no more."""
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        self._pending.clear()

    def _marker(self, index: TileIndex, tile: MeshTile | None, frame: str) -> bytes:
        number = self._numbers.setdefault(index, len(self._numbers) + 1)
        if tile is None:
            return marker_message(frame, number, DELETE)
        vertices = tile.origin + tile.vertices.astype(np.float64)
        return marker_message(frame, number, corners=vertices[tile.faces.ravel()])
