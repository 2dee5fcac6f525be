"""The border of free space without a surface: the faces between free and unknown cells."""

import numpy as np
from matplotlib.colors import to_rgb
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Bytes, Floats, Ints
from triquad_format.records.status import Status

from triquad_tools.viewer.page.layer import Answer, Question
from triquad_tools.viewer.page.legends import lines_html, text_html
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.questions.cell_box import CellBox

_COUNTS = (64, 64, 24)  # cells: they bound how much is asked
_MOST_CELL_M = 0.75
_VOXEL_CELLS = 2  # a cell of the mesh is half a voxel, as fine as the status is known
_NO_DISTANCE_M = 0.01  # status is what is asked for; searching far costs most
_COLOUR, _OPACITY = "#cc79a7", 0.4
_LEGEND = lines_html((_COLOUR, "between free and unknown space"))


class UnknownSpace(Question[CellBox]):
    """Shows the boundary of free against unknown space around the camera's target."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Unknown space")
        with self.folder:
            self._on = page.gui.add_checkbox("Show border", False)
            self.add_text()
        self.start(self._on)

    def wanted(self) -> CellBox | None:
        """Return the cells around the camera's target."""
        if not self._on.value:
            return None
        focus, least_m = self.page.focus, _VOXEL_CELLS * self.page.source.sizes.cell_m
        cell_m = max(min(focus.side_m / _COUNTS[0], _MOST_CELL_M), least_m)
        return CellBox.around(focus.middle, cell_m, _COUNTS)

    def ask(self, wanted: CellBox) -> Answer:
        """Ask for the status of all cells."""
        cells, steps, epoch = ask_boundary(self.page.source.queries, wanted)
        marks = []
        if len(cells):
            surface = self.page.scene.add_mesh_simple(
                self.node("border"), *face_triangles(cells, steps), color=np.array(to_rgb(_COLOUR)),
                opacity=_OPACITY, flat_shading=True, side="double", scale=wanted.cell_m,
                cast_shadow=False, receive_shadow=False,
                position=self.page.in_scene(np.array(wanted.corner)),
            )  # fmt: skip
            marks.append(surface)
        wide, _, high = wanted.size_m
        extent = f"{wide:.3g} x {wide:.3g} x {high:.3g} m around the middle of the view"
        told = f"{extent}, in cells of {wanted.cell_m:.2g} m; epoch {epoch}"
        return Answer(_LEGEND + text_html(told), epoch, marks)


def ask_boundary(queries: MapQueries, box: CellBox) -> tuple[Ints, Ints, int]:
    """Return the faces of a box between free and unknown space, and the epoch.

    Faces are as of :func:`border_faces`. Cells are coarse: where there is a surface between their
    middles, there is no such face.

    Raises:
        TriquadError: the map does not answer.
    """
    answer = box.ask(queries, _NO_DISTANCE_M)
    cells, steps = border_faces(answer.status)
    if len(cells):
        rays = queries.query_rays(box.places(cells + 0.5), steps, box.cell_m)
        passed = rays.status != Status.SURFACE
        cells, steps = cells[passed], steps[passed]
    return cells, steps, answer.epoch


def border_faces(status: Bytes) -> tuple[Ints, Ints]:
    """Return the faces of free cells beyond which the cell is unknown, for the status [x, y, z].

    Returns:
        The free cells [N, 3], and the steps [N, 3] from there to the unknown ones.
    """
    free, unknown = (np.pad(status == kind, 1) for kind in (Status.FREE, Status.UNKNOWN))
    steps = np.concatenate([np.eye(3, dtype=np.int32), -np.eye(3, dtype=np.int32)])
    cells = [np.argwhere(free & np.roll(unknown, tuple(-step), (0, 1, 2))) - 1 for step in steps]
    counts = [len(found) for found in cells]
    return np.concatenate(cells).astype(np.int32), steps.repeat(counts, axis=0)


def face_triangles(cells: Ints, steps: Ints) -> tuple[Floats, Ints]:
    """Return vertices [4 N, 3], in cells, and rows of them [2 N, 3]: two triangles of each face."""
    across = np.roll(np.abs(steps), 1, axis=1)
    up = np.roll(across, 1, axis=1)
    corner = cells + np.maximum(steps, 0)
    quads = np.stack([corner, corner + across, corner + across + up, corner + up], axis=1)
    first = 4 * np.arange(len(quads), dtype=np.int32)[:, None, None]
    rows = first + np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return quads.reshape(-1, 3).astype(np.float32), rows.reshape(-1, 3)
