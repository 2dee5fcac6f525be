"""A slice through the distances of a map, placed by a person."""

import numpy as np
import viser
from viser.transforms import SO3

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import BEHIND, DISTANCE_COLOURS
from triquad_tools.viewer.asking.cell_box import CellBox
from triquad_tools.viewer.asking.picking import ground_in_view
from triquad_tools.viewer.asking.slices import (
    HEIGHT_AXIS,
    ask_slice,
    line_distances,
    picture,
    slice_axes,
    slice_box,
)
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import ColourScale, Legend, LineMeaning, text_html
from triquad_tools.viewer.page.page import Page

_PERIOD_S = 0.5
_AXES = {"level, at some z": HEIGHT_AXIS, "upright, at some x": 0, "upright, at some y": 1}
_REACH_M = 20.0  # of the slider, to both sides of where the slice was put
_STEP_M = 0.05
_ABOVE_M = 0.75  # the ground in the middle of the view: where a level slice is put
_MAX_DISTANCE_M = 3.0


class SliceLayer(Layer):
    """Draws a slice around the camera's target."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Slice", _PERIOD_S)
        self._box: CellBox | None = None  # of the picture
        self._picture: viser.ImageHandle | None = None
        self._unplaced = True
        gui = page.gui
        with self.folder:
            self._on = gui.add_checkbox("Show slice", False)
            self._kind = gui.add_dropdown("Slice", tuple(_AXES), visible=False)
            self._at = gui.add_slider("At (m)", -_REACH_M, _REACH_M, _STEP_M, 0.0, visible=False)
            self._here = gui.add_button("Through the middle of the view", visible=False)
            self._most = gui.add_number(
                "Up to (m)", _MAX_DISTANCE_M, min=0.2, max=50.0, step=0.1, visible=False
            )
            self._text = gui.add_html("", visible=False)
        self._kind.on_update(self._place_again)
        self._here.on_click(self._place_again)
        self.start(self._on, self._at, self._most)

    def refresh(self) -> None:
        """Ask if the camera's target, the map or a control has changed."""
        for control in (self._kind, self._at, self._here, self._most, self._text):
            control.visible = self._on.value
        if not self._on.value:
            self.erase()
            return
        if self._unplaced:
            self._place()
        most_m, axis = float(self._most.value), _AXES[self._kind.value]
        box = slice_box(self.page.focus, axis, self._at.value)
        if not self.outdated((box, most_m)):
            return
        answer = ask_slice(self.page.source.queries, box, axis, most_m)
        self.answered((box, most_m), answer.epoch)
        image, legend = picture(answer, most_m), _legend(most_m)
        self._text.content = legend.html + text_html(f"epoch {answer.epoch}")
        # The same node where only its colours change: a new one is white until it is decoded.
        if self._picture is not None and self.drawn and box == self._box:
            self._picture.image = image
            self.page.legends[self.name] = legend
            return
        across, up = np.delete(box.size_m, axis).tolist()
        self._picture = self.page.scene.add_image(
            self.node("picture"), image, across, up, format="png", cast_shadow=False,
            receive_shadow=False, wxyz=SO3.from_matrix(slice_axes(axis)).wxyz,
            position=self.page.in_scene(box.middle),
        )  # fmt: skip
        self._box = box
        self.draw([self._picture], legend)

    def _place_again(self, _: object) -> None:
        self._unplaced = True
        self.wake()

    def _place(self) -> None:
        """Put the slice through the middle of the view, with room to move it."""
        axis = _AXES[self._kind.value]
        above_m = _ABOVE_M if axis == HEIGHT_AXIS else 0.0
        at_m = round(float(ground_in_view(self.page)[axis]) + above_m, 2)
        self._unplaced = False
        self._at.min, self._at.max = at_m - _REACH_M, at_m + _REACH_M
        self._at.value = at_m  # type: ignore[misc]  # mypy takes it for read-only


def _legend(max_distance_m: float) -> Legend:
    lines = (
        LineMeaning("#000000", "the surface itself"),
        LineMeaning("#ffffff", f"white: every {line_distances(max_distance_m)[1]:g} m from it"),
        LineMeaning(BEHIND, "behind a surface"),
        LineMeaning(UNKNOWN, "unknown: not seen"),
    )
    label = "distance to the nearest surface, m"
    scale = ColourScale(label, DISTANCE_COLOURS, 0.0, max_distance_m, open_above=True)
    return Legend(scale, lines)
