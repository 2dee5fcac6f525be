"""A slice of the map as ``nav_msgs/OccupancyGrid``, around where the robot is."""

import logging
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from triquad_client import Client, Grid, Status
from triquad_format.errors import TriquadError

from triquad_tools.ros2.intake.scan_publisher import Place
from triquad_tools.ros2.options import SliceShape
from triquad_tools.ros2.output.topic_publisher import TopicPublisher
from triquad_tools.sensors.ros.type_store import OCCUPANCY_GRID, encode_cdr, type_store

_log = logging.getLogger("triquad_ros2")

_TICK_S = 0.2
_PERIOD_S = 1.0  # between two slices
_MAX_SHARE = 4  # the server works on slices for at most one part in four of the time

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""The values of cells, as nav_msgs/OccupancyGrid has them."""


class GridPublisher:
    """Publishes slices of the map while they have subscribers, on a thread of its own."""

    def __init__(
        self,
        publisher: TopicPublisher,
        client: Client,
        shape: SliceShape,
        place: Callable[[], Place | None],
    ) -> None:
        """``place`` tells where the robot is, None before that is known."""
        self._publisher = publisher
        self._client = client
        self._shape = shape
        self._place = place
        self._shown: tuple[int, Sequence[float]] | None = None  # epoch and corner of the last slice
        self._due_s = 0.0  # monotonic
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-grid")
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(_TICK_S):
            if self._publisher.has_newcomers():
                self._shown = None
            started, place = time.monotonic(), self._place()
            if place is None or started < self._due_s or not self._publisher.is_followed:
                continue
            try:
                self._publish(place)
            except TriquadError as error:
                _log.warning("the slice cannot be made now: %s", error)
            except Exception:
                _log.exception("the slice could not be published")
            now = time.monotonic()
            self._due_s = max(started + _PERIOD_S, now + (_MAX_SHARE - 1) * (now - started))

    def _publish(self, place: Place) -> None:
        """Publish a slice where the map or the place changed since the last."""
        bounds = self._shape.around(place.position_m)
        state = (self._client.status().epoch, bounds[0])
        if state == self._shown:
            return
        cell_m = self._shape.cell_m
        found = self._client.query_grid(bounds, cell_m, max_distance_m=cell_m)
        self._publisher.put(grid_message(found, place))
        self._shown = (found.epoch, bounds[0])


def occupancy(found: Grid) -> NDArray[np.int8]:
    """The values [y, x] of a slice's cells: occupied where a surface meets them."""
    distance, status = found.distance_m[:, :, 0].T, found.status[:, :, 0].T
    is_unknown = status == Status.UNKNOWN
    values = np.where(is_unknown, UNKNOWN, FREE).astype(np.int8)
    # Behind a surface distances are negative; how far, nobody knows where nobody saw.
    nearest = np.where(is_unknown, np.abs(distance), distance)
    values[nearest <= found.shape.cell_m / 2] = OCCUPIED
    return values


def grid_message(found: Grid, place: Place) -> bytes:
    """A slice as a message, CDR."""
    types = type_store().types

    def new(name: str, *values: object) -> object:
        return types[name](*values)  # type: ignore[arg-type]

    time_ = new("builtin_interfaces/msg/Time", *divmod(place.stamp_ns, 10**9))
    origin = new(
        "geometry_msgs/msg/Pose",
        new("geometry_msgs/msg/Point", *map(float, found.shape.corner)),
        new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
    )
    width, height, _ = found.shape.counts
    message = new(
        OCCUPANCY_GRID,
        new("std_msgs/msg/Header", time_, place.map_frame),
        new("nav_msgs/msg/MapMetaData", time_, found.shape.cell_m, width, height, origin),
        occupancy(found).reshape(-1),
    )
    return encode_cdr(message, OCCUPANCY_GRID)
