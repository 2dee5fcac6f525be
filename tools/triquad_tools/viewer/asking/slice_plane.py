"""A slice of a map: where it lies, and what the map says there."""

from dataclasses import dataclass

import numpy as np
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Bools, Doubles, Floats
from triquad_format.records.status import Status
from triquad_map.questions.distance import Distances

from triquad_tools.viewer.asking.questions import in_small_parts
from triquad_tools.viewer.page.focus import Focus

_CELLS = 192  # along the longer side
_SNAPS = 8  # to a side: a smaller move of the view moves no slice
_PART = 4096  # cells of one request, which takes a server some tens of milliseconds
_FLAT = 0.5  # height of an upright slice, as a share of its width

HEIGHT_AXIS = 2


@dataclass(frozen=True)
class SlicePlane:
    """A rectangle of square cells at right angles to an axis of the map frame.

    Its columns run along the first of the other two axes, its rows along the second.
    """

    axis: int  # 0, 1, 2: it is at some x, y or z
    at_m: float
    low_m: tuple[float, float]  # corner of least column and row
    cell_m: float
    columns: int
    rows: int

    @classmethod
    def around(cls, focus: Focus, axis: int, at_m: float) -> "SlicePlane":
        """The slice at ``at_m`` along an axis, around what is looked at."""
        middle = focus.snapped(focus.side_m / _SNAPS)
        cell_m = focus.side_m / _CELLS
        rows = _CELLS if axis == HEIGHT_AXIS else round(_FLAT * _CELLS)
        across, up = (float(middle[other]) for other in _others(axis))
        low_m = (across - 0.5 * _CELLS * cell_m, up - 0.5 * rows * cell_m)
        return cls(axis, at_m, low_m, cell_m=cell_m, columns=_CELLS, rows=rows)

    @property
    def size_m(self) -> tuple[float, float]:
        """Lengths of its sides, along columns and rows."""
        return self.columns * self.cell_m, self.rows * self.cell_m

    @property
    def axes(self) -> Doubles:
        """Unit vectors [3, 3] as columns of a rotation: along a row, along a column, and across."""
        across, up = np.eye(3)[list(_others(self.axis))]
        return np.stack([across, up, np.cross(across, up)], axis=1)

    def places(self, columns: Doubles, rows: Doubles) -> Doubles:
        """Points [N, 3], metres, map frame, of columns and rows [N]: whole numbers are middles."""
        places = np.full((len(columns), 3), self.at_m)
        across, up = _others(self.axis)
        places[:, across] = self.low_m[0] + (columns + 0.5) * self.cell_m
        places[:, up] = self.low_m[1] + (rows + 0.5) * self.cell_m
        return places

    def middle(self) -> Doubles:
        """Its middle [3]."""
        columns, rows = 0.5 * (self.columns - 1), 0.5 * (self.rows - 1)
        middle: Doubles = self.places(np.array([columns]), np.array([rows]))[0]
        return middle


@dataclass(frozen=True)
class Slice:
    """What a map says on a plane."""

    plane: SlicePlane
    distance_m: Floats  # [rows, columns] at the middles of the cells
    known: Bools  # [rows, columns] whether anything was seen there
    epoch: int


def ask_slice(queries: MapQueries, plane: SlicePlane, max_distance_m: float) -> Slice:
    """Ask for all of a plane, in small parts of one epoch.

    Raises:
        TriquadError: the map does not answer.
    """
    rows, columns = np.indices((plane.rows, plane.columns), np.float64).reshape(2, -1)
    points = plane.places(columns, rows)

    def ask(part: slice, epoch: int | None) -> Distances:
        return queries.query_distance(points[part], max_distance_m, at_epoch=epoch)

    parts = in_small_parts(ask, len(points), _PART)
    shape = (plane.rows, plane.columns)
    status = np.concatenate([part.status for part in parts]).reshape(shape)
    distance_m = np.concatenate([part.distance_m for part in parts]).reshape(shape)
    return Slice(plane, distance_m, status != Status.UNKNOWN, epoch=parts[0].epoch)


def _others(axis: int) -> tuple[int, int]:
    """The other two axes."""
    across, up = (other for other in range(3) if other != axis)
    return across, up
