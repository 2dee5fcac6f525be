"""A slice of the map as ``nav_msgs/OccupancyGrid``, around where the robot is."""

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from triquad_client import Client, Grid, Status
from triquad_format.scan_log.ros_messages import CdrWriter
from triquad_map.questions.distance import meets_surface

from triquad_tools.ros2.intake.scan_publisher import Place
from triquad_tools.ros2.options import SliceShape
from triquad_tools.ros2.output.topic_publisher import TopicPublisher

_PERIOD_S = 1.0  # between two slices
_MAX_SHARE = 4  # the server works on slices for at most one part in four of the time
FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # the values of cells, as nav_msgs/OccupancyGrid has them


class GridPublisher:
    """Publishes slices of the map while they have subscribers."""

    def __init__(self, publisher: TopicPublisher, client: Client, shape: SliceShape) -> None:
        self._publisher = publisher
        self._client = client
        self._shape = shape
        self._shown: tuple[int, Sequence[float]] | None = None  # epoch and corner of the last slice
        self._due_s = 0.0  # monotonic

    def publish(self, place: Place, _: float) -> None:
        """Publish a slice where the map or the place changed since the last."""
        followed, started_s = self._publisher.is_followed, time.monotonic()
        if self._publisher.has_newcomers() or not followed:
            self._shown = None
        if started_s < self._due_s or not followed:
            return
        bounds = self._shape.around(place.position_m)
        if (self._client.status().epoch, bounds[0]) == self._shown:
            return
        cell_m = self._shape.cell_m
        found = self._client.query_grid(bounds, cell_m, max_distance_m=cell_m)
        self._publisher.put(grid_message(found, place))
        self._shown = (found.epoch, bounds[0])
        took_s = time.monotonic() - started_s
        self._due_s = started_s + max(_PERIOD_S, _MAX_SHARE * took_s)


def occupancy(found: Grid) -> NDArray[np.int8]:
    """Return the values [y, x] of a slice's cells: occupied where a surface meets them."""
    distance, status = found.distance_m[:, :, 0].T, found.status[:, :, 0].T
    values = np.where(status == Status.UNKNOWN, UNKNOWN, FREE).astype(np.int8)
    values[meets_surface(distance, status, found.shape.cell_m / 2)] = OCCUPIED
    return values


def grid_message(found: Grid, place: Place) -> bytes:
    """Return a slice as a message, CDR."""
    seconds, nanoseconds = divmod(place.stamp_ns, 10**9)
    width, height, _ = found.shape.counts
    writer = CdrWriter().numbers("<u4", seconds, nanoseconds).text(place.map_frame)
    writer.numbers("<u4", seconds, nanoseconds).numbers("<f4", found.shape.cell_m)
    writer.numbers("<u4", width, height)
    writer.numbers("<f8", *found.shape.corner, 0, 0, 0, 1)  # position and rotation of the origin
    return writer.sequence(occupancy(found).reshape(-1)).payload()
