"""A slice of the map as ``nav_msgs/OccupancyGrid``, around where the robot is."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status
from triquad_map.compiled.priority import lower_priority
from triquad_map.compiled.team import Team
from triquad_map.questions.grid import Grid, GridShape, grid
from triquad_tools.sensors.ros.type_store import OCCUPANCY_GRID, encode_cdr, type_store

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.process.threads import NICENESS
from triquad_server.ros2.intake.scans import Place
from triquad_server.ros2.output.outlet import Outlet
from triquad_server.settings import Ros2Settings

_log = logging.getLogger("triquad_server.ros2")

_TICK_S = 0.2
_MAX_SHARE = 4
"""Making slices takes at most one part in so many of the thread's time."""

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""The values of cells, as nav_msgs/OccupancyGrid has them."""


@dataclass(frozen=True)
class SliceShape:
    """Which slice of the map is published."""

    height_m: float
    cell_m: float
    cells: int  # along each side

    @classmethod
    def of_settings(cls, settings: Ros2Settings) -> "SliceShape":
        """That of the settings."""
        return cls(settings.grid_height_m, settings.grid_cell_m, settings.grid_cells)

    def around(self, position_m: Doubles) -> GridShape:
        """The slice around a position, on a lattice that stays."""
        first = np.round(position_m[:2] / self.cell_m) - self.cells // 2
        corner = np.array([*(first * self.cell_m), self.height_m - self.cell_m / 2])
        return GridShape(corner, self.cell_m, (self.cells, self.cells, 1))


class GridOutlet:
    """Publishes slices of published epochs, on a thread of its own."""

    def __init__(
        self,
        outlet: Outlet,
        epochs: EpochHistory,
        shape: SliceShape,
        *,
        period_s: float,
        team: Team,  # shares the work
        place: Callable[[], Place | None],
    ) -> None:
        """``place`` tells where the robot is, None before that is known."""
        self._outlet = outlet
        self._epochs = epochs
        self._shape = shape
        self._period_s = period_s
        self._team = team
        self._place = place
        self._shown: tuple[int, bytes] | None = None  # epoch and corner of the last slice
        self._next_s = 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-grid")
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        lower_priority(NICENESS)
        while not self._stopping.wait(_TICK_S):
            try:
                self._turn()
            except Exception:
                _log.exception("ros2: the slice could not be published")
                self._next_s = time.monotonic() + self._period_s

    def _turn(self) -> None:
        if self._outlet.has_newcomers():
            self._shown = None
        started, place = time.monotonic(), self._place()
        if place is None or started < self._next_s or not self._outlet.is_followed:
            return
        epoch, shape = self._epochs.newest, self._shape.around(place.position_m)
        state = (epoch.number, shape.corner.tobytes())
        if state == self._shown:
            return
        self._outlet.put(grid_message(self._slice(epoch, shape), place))
        self._shown = state
        now = time.monotonic()
        self._next_s = now + max(self._period_s, _MAX_SHARE * (now - started))

    def _slice(self, epoch: Epoch, shape: GridShape) -> Grid:
        return grid(epoch.asked_with(self._team.split), shape, shape.cell_m)


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
