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
from triquad_tools.sensors.ros.cdr import CdrWriter

_log = logging.getLogger("triquad_ros2")

_TICK_S = 0.2
_PERIOD_S = 1.0  # between two slices
_RETRY_S = 5.0  # after an error
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
        """``place`` returns where the robot is, None before that is known."""
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
                pause_s = max(_PERIOD_S, _MAX_SHARE * (time.monotonic() - started))
            except TriquadError as error:
                _log.warning("the slice cannot be made now: %s", error)
                pause_s = _RETRY_S
            except Exception:
                _log.exception("the slice could not be published")
                pause_s = _RETRY_S
            self._due_s = started + pause_s

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
    """Return the values [y, x] of a slice's cells: occupied where a surface meets them."""
    distance, status = found.distance_m[:, :, 0].T, found.status[:, :, 0].T
    is_unknown = status == Status.UNKNOWN
    values = np.where(is_unknown, UNKNOWN, FREE).astype(np.int8)
    # Behind a surface distances are negative; how far, nobody knows where nobody saw.
    nearest = np.where(is_unknown, np.abs(distance), distance)
    values[nearest <= found.shape.cell_m / 2] = OCCUPIED
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
