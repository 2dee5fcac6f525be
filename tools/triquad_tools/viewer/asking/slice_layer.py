"""A slice through the distances of a map, where a person puts it."""

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import BEHIND
from triquad_tools.viewer.asking.contours import contour_step
from triquad_tools.viewer.asking.distance_scale import distance_scale
from triquad_tools.viewer.asking.picking import ground_in_view
from triquad_tools.viewer.asking.questions import Pace, newest_epoch
from triquad_tools.viewer.asking.slice_drawing import SliceDrawing
from triquad_tools.viewer.asking.slice_plane import HEIGHT_AXIS, SlicePlane, ask_slice
from triquad_tools.viewer.page.focus import focus_of
from triquad_tools.viewer.page.legends import Legend, LineMeaning
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import text_html
from triquad_tools.viewer.page.refresher import Refresher

_PERIOD_S = 0.5
_AXES = {"level, at some z": HEIGHT_AXIS, "upright, at some x": 0, "upright, at some y": 1}
_REACH_M = 20.0  # of the slider, to both sides of where the slice was put
_STEP_M = 0.05
_ABOVE_M = 0.75  # the ground in the middle of the view: where a level slice is put
_MAX_DISTANCE_M = 3.0
_NAME = "slice"


class SliceLayer:
    """Draws a slice around what the camera looks at."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._drawing = SliceDrawing(page)
        self._pace = Pace()
        self._unplaced = True
        self._drawn: tuple[SlicePlane, float] | None = None
        self._epoch = 0
        gui = page.gui
        self._folder = gui.add_folder("Slice")
        with self._folder:
            self._shown = gui.add_checkbox("Show slice", False)
            self._kind = gui.add_dropdown("Slice", tuple(_AXES), visible=False)
            self._at = gui.add_slider("At (m)", -_REACH_M, _REACH_M, _STEP_M, 0.0, visible=False)
            self._here = gui.add_button("Through the middle of the view", visible=False)
            self._most = gui.add_number(
                "Up to (m)", _MAX_DISTANCE_M, min=0.2, max=50.0, step=0.1, visible=False
            )
            self._legend = gui.add_html("", visible=False)
        self._refresher = Refresher("slice", self._refresh, period_s=_PERIOD_S, failed=page.failed)
        for control in (self._shown, self._at, self._most):
            control.on_update(lambda _: self._refresher.wake())
        self._kind.on_update(self._place_anew)
        self._here.on_click(self._place_anew)

    def close(self) -> None:
        """Draw no more; what was drawn and the folder go."""
        self._refresher.close()
        self._erase()
        self._folder.remove()

    def _place_anew(self, _: object) -> None:
        self._unplaced = True
        self._refresher.wake()

    def _refresh(self) -> None:
        shown = self._shown.value
        for control in (self._kind, self._at, self._here, self._most, self._legend):
            control.visible = shown
        if not shown:
            self._erase()
            return
        if self._unplaced:
            self._place()
        plane = SlicePlane.around(focus_of(self._page), _AXES[self._kind.value], self._at.value)
        wanted = (plane, float(self._most.value))
        queries = self._page.source.queries
        if wanted != self._drawn or (self._pace.due and newest_epoch(queries) != self._epoch):
            with self._pace.asking():
                answer = ask_slice(queries, *wanted)
            self._drawing.draw(answer, wanted[1])
            self._explain(wanted[1], answer.epoch)
            self._drawn, self._epoch = wanted, answer.epoch

    def _erase(self) -> None:
        self._drawing.erase()
        self._drawn = None
        self._page.legends.hide(_NAME)

    def _place(self) -> None:
        """Put the slice through the middle of the view, with room to move it."""
        axis = _AXES[self._kind.value]
        above_m = _ABOVE_M if axis == HEIGHT_AXIS else 0.0
        at_m = round(float(ground_in_view(self._page)[axis]) + above_m, 2)
        self._unplaced = False
        self._at.min, self._at.max = at_m - _REACH_M, at_m + _REACH_M
        self._at.value = at_m  # type: ignore[misc]  # mypy takes it for read-only

    def _explain(self, max_distance_m: float, epoch: int) -> None:
        step_m = contour_step(max_distance_m)
        scale = distance_scale("distance to the nearest surface, m", max_distance_m)
        lines = (
            LineMeaning("#000000", False, "the surface itself"),
            LineMeaning("#ffffff", False, f"white: every {step_m:g} m from it"),
            LineMeaning(BEHIND, False, "behind a surface"),
            LineMeaning(UNKNOWN, False, "unknown: not seen"),
        )
        legend = Legend(scale, lines)
        self._page.legends.show(_NAME, legend)
        self._legend.content = legend.html + text_html(f"epoch {epoch}")
