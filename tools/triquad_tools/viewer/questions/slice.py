"""A slice through the distances of a map, placed by a person."""

from dataclasses import dataclass

import numpy as np
import viser
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats
from triquad_format.records.status import Status
from viser.transforms import SO3

from triquad_tools.plots.colours import BEHIND, DISTANCES, UNKNOWN
from triquad_tools.viewer.page.layer import Answer, Question
from triquad_tools.viewer.page.legends import ColourScale, lines_html, text_html
from triquad_tools.viewer.page.page import Focus, Page, ground_in_view
from triquad_tools.viewer.questions.cell_box import CellBox

_HEIGHT_AXIS = 2
_AXES = {"level, at some z": _HEIGHT_AXIS, "upright, at some x": 0, "upright, at some y": 1}
_CELLS, _UPRIGHT_CELLS = 192, 96  # along the width, and along the height of an upright slice
_REACH_M = 20.0  # of the slider, at most, to both sides of where the slice was put
_BEYOND = 0.1  # the map it reaches as well, as a share of the map's longest side
_STEP_M = 0.05
_ABOVE_M = 0.75  # the ground in the middle of the view: where a level slice is put
_MAX_DISTANCE_M = 3.0
_PIXELS, _DPI = 6, 100  # along a cell, so that the browser blurs no more than their borders
_LINE_PT, _SURFACE_PT, _LETTERS_PT = 1.2, 3.0, 14
_LEVELS = MaxNLocator(8, steps=[1, 2, 5, 10])  # no more lines, at round distances


@dataclass(frozen=True)
class Slice:
    """One layer of cells across an axis, and up to where distances are asked for."""

    box: CellBox
    axis: int  # 0, 1 or 2: x, y or z
    most_m: float

    @classmethod
    def around(cls, focus: Focus, axis: int, at_m: float, most_m: float) -> "Slice":
        """Return the slice at some x, y or z, around the middle of a view."""
        counts = [_CELLS, _CELLS, _CELLS if axis == _HEIGHT_AXIS else _UPRIGHT_CELLS]
        counts[axis] = 1
        cell_m = focus.side_m / _CELLS
        corner = list(CellBox.around(focus.middle, cell_m, tuple(counts)).corner)
        corner[axis] = at_m - 0.5 * cell_m
        return cls(CellBox(tuple(corner), cell_m, tuple(counts)), axis, most_m)

    @property
    def turn(self) -> Doubles:
        """The rotation [3, 3] whose columns lead along rows, along columns and across."""
        across, up = np.delete(np.eye(3), self.axis, axis=0)
        return np.stack([across, up, np.cross(across, up)], axis=1)

    @property
    def legend(self) -> str:
        """The meaning of its colours and lines."""
        label = "distance to the nearest surface, m"
        scale = ColourScale(label, DISTANCES, 0.0, self.most_m, open_above=True)
        return scale.html + lines_html(
            ("#000000", "the surface itself"),
            ("#ffffff", f"white: every {_line_distances(self.most_m)[1]:g} m from it"),
            (BEHIND, "behind a surface"),
            (UNKNOWN, "unknown: not seen"),
        )


class SliceQuestion(Question[Slice]):
    """Shows distances in a slice around the camera's target."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Slice")
        self._drawn: tuple[CellBox, viser.ImageHandle] | None = None
        self._unplaced = True
        gui = page.gui
        with self.folder:
            self._on = gui.add_checkbox("Show slice", False)
            self._kind = gui.add_dropdown("Slice", tuple(_AXES), visible=False)
            self._at = gui.add_slider("At (m)", -_REACH_M, _REACH_M, _STEP_M, 0.0, visible=False)
            self._here = gui.add_button("Through the middle", visible=False)
            self._most = gui.add_number(
                "Up to (m)", _MAX_DISTANCE_M, min=0.2, max=50.0, step=0.1, visible=False
            )
            self.add_text()
        self._kind.on_update(self._place_again)
        self._here.on_click(self._place_again)
        self.start(self._on, self._at, self._most)

    def wanted(self) -> Slice | None:
        """Return the slice at the slider's place."""
        for control in (self._kind, self._at, self._here, self._most):
            control.visible = self._on.value
        if not self._on.value:
            self._drawn = None
            return None
        axis = _AXES[self._kind.value]
        if self._unplaced:
            self._place(axis)
        return Slice.around(self.page.focus, axis, self._at.value, float(self._most.value))

    def ask(self, wanted: Slice) -> Answer:
        """Ask for distances at all cells."""
        box, axis = wanted.box, wanted.axis
        found = box.ask(self.page.source.queries, wanted.most_m)
        distance_m, status = (values.take(0, axis).T for values in (found.distance_m, found.status))
        image = _picture(distance_m, status != Status.UNKNOWN, wanted.most_m)
        # The same node where only its colours change: a new one is white until it is decoded.
        if self._drawn is not None and self._drawn[0] == box:
            self._drawn[1].image = image
        else:
            across, up = np.delete(box.size_m, axis).tolist()
            picture = self.page.scene.add_image(
                self.node("picture"), image, across, up, format="png", cast_shadow=False,
                receive_shadow=False, wxyz=SO3.from_matrix(wanted.turn).wxyz,
                position=self.page.in_scene(box.places(0.5 * np.array(box.counts))),
            )  # fmt: skip
            self._drawn = box, picture
        html = wanted.legend + text_html(f"epoch {found.epoch}")
        return Answer(html, found.epoch, [self._drawn[1]])

    def _place_again(self, _: object) -> None:
        self._unplaced = True
        self.wake()

    def _place(self, axis: int) -> None:
        """Put the slice through the middle of the view, with room to move it."""
        above_m = _ABOVE_M if axis == _HEIGHT_AXIS else 0.0
        at_m = float(ground_in_view(self.page)[axis]) + above_m
        low_m, at_m, high_m = slider_places(self.page.extent, axis, at_m)
        self._unplaced = False
        self._at.min, self._at.max = low_m, high_m
        self._at.value = at_m  # type: ignore[misc]  # mypy takes it for read-only


def slider_places(extent: Doubles | None, axis: int, wanted_m: float) -> tuple[float, float, float]:
    """Return the least place of a slice, where it is put first, and the greatest one, metres.

    They are those of the map's ``extent`` [2, 3], and a little beyond, as far as a slider can show
    them in steps; ``None``: nothing is known of it.
    """
    ends_m = np.array([wanted_m - _REACH_M, wanted_m + _REACH_M])
    if extent is not None:
        beyond_m = max(_BEYOND * float(np.ptp(extent, axis=0).max()), _STEP_M)
        ends_m = extent[:, axis] + [-beyond_m, beyond_m]
    first_m = float(np.clip(wanted_m, *ends_m))
    low_m, high_m = np.clip(ends_m, first_m - _REACH_M, first_m + _REACH_M).round(2).tolist()
    return low_m, min(max(round(first_m, 2), low_m), high_m), high_m


def _line_distances(max_distance_m: float) -> Doubles:
    """Return the round distances at which a slice has lines, from 0 up, metres."""
    levels = np.asarray(_LEVELS.tick_values(0.0, max_distance_m), np.float64)
    return levels[levels < max_distance_m]


def _picture(distance_m: Floats, known: Bools, max_distance_m: float) -> Bytes:
    """Return colours [height, width, 3], the least row first, with lines at round distances.

    Lines end where nothing was seen, where ``known`` [rows, columns] is false; those of the surface
    itself are black. The scale of colours ends at ``max_distance_m``.
    """
    rows, columns = known.shape
    figure = Figure((columns * _PIXELS / _DPI, rows * _PIXELS / _DPI), _DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False)
    axes.set_axis_off()
    colours = DISTANCES(distance_m.astype(np.float64) / max_distance_m)[..., :3]
    colours[~known] = to_rgb(UNKNOWN)
    axes.imshow(colours, origin="lower", aspect="auto", interpolation="nearest")
    if known.any():
        shown_m = np.ma.array(distance_m, mask=~known)
        levels = _line_distances(max_distance_m)[1:]
        lines = axes.contour(shown_m, levels, colors="white", linewidths=_LINE_PT)
        axes.clabel(lines, fmt="%g m", fontsize=_LETTERS_PT)
        axes.contour(shown_m, [0.0], colors="black", linewidths=_SURFACE_PT)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    drawn = canvas.buffer_rgba()  # type: ignore[no-untyped-call]
    return np.asarray(drawn)[::-1, :, :3]
