"""A path that is laid by clicks, checked for a robot of some size."""

from collections.abc import Callable

import numpy as np
from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Doubles

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import BEHIND
from triquad_tools.viewer.asking.distance_scale import distance_scale
from triquad_tools.viewer.asking.path_check import PathAnswer, ask_path
from triquad_tools.viewer.asking.path_drawing import PathDrawing
from triquad_tools.viewer.asking.questions import newest_epoch
from triquad_tools.viewer.page.legends import Legend, LineMeaning
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import table_html, text_html

_RADIUS_M = 0.3
_NAME = "path"
_LINES = (
    LineMeaning(BEHIND, False, "blocked: the robot touches a surface"),
    LineMeaning(UNKNOWN, False, "the robot is in unknown space"),
)
_LEAST_LEG_M = 0.01  # a second click at the same place adds nothing
_UNANSWERED = "The map does not answer about this path."
_SKY = "No surface there: the path stays as it was."


class PathProbe:
    """The path, its controls, and what the map says about it."""

    def __init__(self, page: Page, do: Callable[[Callable[[], None]], None]) -> None:
        """``do`` has something done on the thread that changes paths."""
        self._page = page
        self._points: list[Doubles] = []
        self._answer: PathAnswer | None = None
        self._drawing = PathDrawing(page)
        gui = page.gui
        self._radius = gui.add_number(
            "Radius (m)", _RADIUS_M, min=0.0, max=50.0, step=0.05, visible=False
        )
        self._undo = gui.add_button("Undo last point", visible=False)
        self._clear = gui.add_button("Clear path", visible=False)
        self._text = gui.add_html(path_html([], None), visible=False)
        self._legend = gui.add_html("", visible=False)
        self._radius.on_update(lambda _: do(self._check))
        self._undo.on_click(lambda _: do(self._undo_last))
        self._clear.on_click(lambda _: do(self.clear))

    @property
    def unanswered(self) -> bool:
        """Whether there is a path that the map was not asked about yet."""
        return len(self._points) > 1 and self._answer is None

    def show_controls(self, shown: bool) -> None:
        """Show controls and texts, or hide them where there is no path either."""
        for control in (self._radius, self._undo, self._clear, self._text, self._legend):
            control.visible = shown or bool(self._points)

    def add(self, surface: Doubles | None, raised_m: float) -> None:
        """Go on to so far above a point [3] of a surface, map frame; ``None``: there was none.

        Raises:
            TriquadError: the map does not answer.
        """
        if surface is None:
            self._text.content = text_html(_SKY) + path_html(self._points, self._answer)
            return
        point = surface + [0.0, 0.0, raised_m]
        if not self._points or np.linalg.norm(point - self._points[-1]) > _LEAST_LEG_M:
            self._points.append(point)
        self._check()

    def refresh(self) -> None:
        """Ask again where the map has gone on.

        Raises:
            TriquadError: the map does not answer.
        """
        answer = self._answer
        asked = answer is None or newest_epoch(self._page.source.queries) == answer.whole.epoch
        if self.unanswered or not asked:
            self._check()

    def clear(self) -> None:
        """Take all of the path away."""
        self._points.clear()
        self._check()

    def _undo_last(self) -> None:
        del self._points[-1:]
        self._check()

    def _check(self) -> None:
        """Ask about the path as it is now, and draw it."""
        self._answer = None
        self._page.legends.hide(_NAME)
        if self.unanswered:
            queries = self._page.source.queries
            points = np.array(self._points)
            try:
                self._answer = ask_path(queries, points, float(self._radius.value))
            except TriquadError:
                # What is drawn was true of another radius, or of another map.
                self._drawing.draw(self._points, None)
                self._text.content = text_html(_UNANSWERED)
                raise
            scale = distance_scale("clearance of the robot's middle, m", self._answer.reach_m)
            legend = Legend(scale, _LINES)
            self._legend.content = legend.html
            self._page.legends.show(_NAME, legend)
        self._text.content = path_html(self._points, self._answer)
        self._drawing.draw(self._points, self._answer)


def path_html(points: list[Doubles], answer: PathAnswer | None) -> str:
    """What the map answers about a path."""
    if answer is None:
        return text_html("One point: click at the next." if points else "Click at the first point.")
    whole = answer.whole
    rows = [("path", f"{len(points)} points, {whole.length_m:.2f} m")]
    if whole.blocked:
        rows.append(("blocked", f"⚠ at {whole.contact_m:.2f} m"))
    if whole.meets_unknown:
        rows.append(("unknown", f"⚠ from {whole.unknown_contact_m:.2f} m"))
    if whole.free():
        rows.append(("free", f"all along, with radius {answer.radius_m:g} m"))
    least = f"{whole.clearance_m:.2f} m, at {whole.clearance_at_m:.2f} m"
    if whole.clearance_m >= answer.reach_m:
        least = f"{answer.reach_m:g} m or more"
    rows += [("least clearance", least), ("epoch", f"{whole.epoch}")]
    return table_html(rows)
