"""Where free space ends without a surface: the faces between free and unknown cells."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints
from triquad_format.records.status import Status
from triquad_map.questions.grid import Grid
from triquad_map.questions.rays import RayRanges

from triquad_tools.viewer.asking.questions import in_small_parts
from triquad_tools.viewer.page.focus import Focus
from triquad_tools.viewer.page.unlit_glb import Triangles

_COLUMNS, _LAYERS = 64, 24  # cells along x and y, and along z: they bound how much is asked
_MOST_CELL_M = 0.75
_SNAPS = 8  # to a side: a smaller move of the view moves no box
_PART_COLUMNS, _PART_RAYS = 4, 1000  # of one request
_NO_DISTANCE_M = 0.01  # status is what is asked for; searching far costs most


@dataclass(frozen=True)
class CellBox:
    """A box of cubic cells."""

    corner: tuple[float, float, float]  # the least one, metres, map frame
    cell_m: float

    @classmethod
    def around(cls, focus: Focus, least_cell_m: float) -> "CellBox":
        """The box around what is looked at, of cells that are no finer than the map's."""
        cell_m = max(min(focus.side_m / _COLUMNS, _MOST_CELL_M), least_cell_m)
        middle = focus.snapped(_COLUMNS * cell_m / _SNAPS)
        x, y, z = (middle - 0.5 * cell_m * np.array([_COLUMNS, _COLUMNS, _LAYERS])).tolist()
        return cls((x, y, z), cell_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """How wide and how high it is."""
        return _COLUMNS * self.cell_m, _LAYERS * self.cell_m

    def places(self, cells: Floats | Ints | Doubles) -> Doubles:
        """Points [N, 3], metres, map frame, of cells [N, 3]: whole numbers are least corners."""
        return np.asarray(self.corner + self.cell_m * cells, np.float64)


class Faces(NamedTuple):
    """Faces of free cells."""

    cells: Ints  # [N, 3]
    steps: Ints  # [N, 3] to the cell beyond the face: one of its numbers is 1 or -1, the others 0


class Boundary(NamedTuple):
    """The boundary of free against unknown space within a box, of one epoch."""

    faces: Faces
    epoch: int


def ask_boundary(queries: MapQueries, box: CellBox) -> Boundary:
    """Ask for the status of the middles of all cells, and for what lies between them.

    Raises:
        TriquadError: the map does not answer.
    """
    parts = in_small_parts(
        lambda part, epoch: _ask_status(queries, box, part, epoch), _COLUMNS, _PART_COLUMNS
    )
    faces = border_faces(np.concatenate([part.status for part in parts]))
    kept = _without_surface(queries, box, faces) if len(faces.cells) else faces
    return Boundary(kept, parts[0].epoch)


def border_faces(status: Bytes) -> Faces:
    """The faces of free cells beyond which the cell is unknown, for the status [x, y, z]."""
    free, unknown = status == Status.FREE, status == Status.UNKNOWN
    cells, steps = [], []
    for axis, step in enumerate(np.eye(3, dtype=np.int32)):
        ends = status.shape[axis] - 1
        before, after = (
            [side.take(range(first, first + ends), axis) for side in (free, unknown)]
            for first in (0, 1)
        )
        upwards, downwards = np.argwhere(before[0] & after[1]), np.argwhere(after[0] & before[1])
        cells += [upwards, downwards + step]
        steps += [np.tile(step, (len(upwards), 1)), np.tile(-step, (len(downwards), 1))]
    return Faces(np.concatenate(cells).astype(np.int32), np.concatenate(steps).astype(np.int32))


def face_triangles(faces: Faces) -> Triangles:
    """Two triangles of each face, with four vertices of their own, in cells.

    They run counter-clockwise seen from the free cell.
    """
    axis = np.abs(faces.steps).argmax(axis=1)
    unit = np.eye(3, dtype=np.int32)
    across, up = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
    ring = np.stack([0 * up, across, across + up, up], axis=1)
    upwards = faces.steps.max(axis=1) > 0
    ring[upwards] = ring[upwards, ::-1]
    quads = (faces.cells + np.maximum(faces.steps, 0))[:, None] + ring
    first = 4 * np.arange(len(quads), dtype=np.int32)[:, None, None]
    rows = first + np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Triangles(quads.reshape(-1, 3).astype(np.float32), rows.reshape(-1, 3))


def _ask_status(queries: MapQueries, box: CellBox, part: slice, epoch: int | None) -> Grid:
    low = np.array([part.start, 0, 0])
    # A hair less: else rounding may make one cell more.
    high = np.array([min(part.stop, _COLUMNS), _COLUMNS, _LAYERS]) - 0.01
    bounds = (box.places(low).tolist(), box.places(high).tolist())
    return queries.query_grid(bounds, box.cell_m, _NO_DISTANCE_M, at_epoch=epoch)


def _without_surface(queries: MapQueries, box: CellBox, faces: Faces) -> Faces:
    """The faces through which one passes from free into unknown space: cells are coarse."""
    middles = box.places(faces.cells + 0.5)

    def ask(part: slice, epoch: int | None) -> RayRanges:
        return queries.query_rays(middles[part], faces.steps[part], box.cell_m, at_epoch=epoch)

    parts = in_small_parts(ask, len(middles), _PART_RAYS)
    passed = np.concatenate([part.status for part in parts]) != Status.SURFACE
    return Faces(faces.cells[passed], faces.steps[passed])
