"""A path that is laid by clicks, checked for a robot of some size."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_format.records.arrays import Bytes, Doubles

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import BEHIND
from triquad_tools.viewer.asking.distance_scale import distance_colours, distance_scale
from triquad_tools.viewer.asking.path_check import PathAnswer, ask_path
from triquad_tools.viewer.asking.questions import newest_epoch
from triquad_tools.viewer.asking.tube import Tube, add_tube
from triquad_tools.viewer.legend import legend_html
from triquad_tools.viewer.panel import table_html, text_html
from triquad_tools.viewer.shown_legends import LineMeaning, lines_html
from triquad_tools.viewer.stage import Stage

_RADIUS_M = 0.3
_NAME = "path"
_LINES = (
    LineMeaning(BEHIND, False, "blocked: the robot touches a surface"),
    LineMeaning(UNKNOWN, False, "the robot is in unknown space"),
)
_LEAST_LEG_M = 0.01  # a second click at the same place adds nothing
_LEAST_WIDTH = 0.002  # radius of what is drawn, as a share of the distance of the eye
_SKY = "No surface there: the path stays as it was."


class PathProbe:
    """The path, its controls, and what the map says about it."""

    def __init__(self, stage: Stage, do: Callable[[Callable[[], None]], None]) -> None:
        """``do`` has something done on the thread that changes paths."""
        self._stage = stage
        self._points: list[Doubles] = []
        self._answer: PathAnswer | None = None
        self._marks: list[viser.SceneNodeHandle] = []
        gui = stage.gui
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
        asked = answer is None or newest_epoch(self._stage.source.queries) == answer.whole.epoch
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
        self._stage.legends.scales.pop(_NAME, None)
        self._stage.legends.lines.pop(_NAME, None)
        if self.unanswered:
            queries = self._stage.source.queries
            points = np.array(self._points)
            self._answer = ask_path(queries, points, float(self._radius.value))
            scale = distance_scale("clearance of the robot's middle, m", self._answer.reach_m)
            self._legend.content = legend_html(scale) + lines_html(_LINES)
            self._stage.legends.scales[_NAME], self._stage.legends.lines[_NAME] = scale, _LINES
        self._text.content = path_html(self._points, self._answer)
        with self._stage.client.atomic():
            self._erase()
            self._draw_points()
            if self._answer is not None:
                self._draw_path(self._answer)

    def _draw_points(self) -> None:
        for number, point in enumerate(self._points, start=1):
            self._mark(f"/path/points/{number}", f"{number}", point, "center-right")

    def _draw_path(self, answer: PathAnswer) -> None:
        eye = self._stage.in_map(self._stage.client.camera.position)
        least_m = _LEAST_WIDTH * float(np.linalg.norm(answer.points[-1] - eye))
        radii_m = np.full(len(answer.cuts), max(answer.radius_m, least_m))
        tube = Tube(answer.cuts, radii_m, piece_colours(answer) / 255.0)
        self._marks.append(add_tube(self._stage, "/path/tube", tube))
        whole = answer.whole
        if whole.meets_unknown:
            text = f"unknown from {whole.unknown_contact_m:.2f} m"
            self._mark("/path/unknown", text, answer.at(whole.unknown_contact_m), "top-left")
        if whole.blocked:
            text = f"✖ blocked at {whole.contact_m:.2f} m"
            self._mark("/path/blocked", text, answer.at(whole.contact_m), "bottom-left")

    def _mark(
        self,
        name: str,
        text: str,
        place: Doubles,
        anchor: Literal["center-right", "bottom-left", "top-left"],
    ) -> None:
        """Write a text beside a place [3]; ``anchor`` is the part of the text that lies there.

        Three of them at one place, as where a path is blocked at its first point, can all be read.
        """
        label = self._stage.scene.add_label(
            name, text, position=self._stage.in_scene(place), anchor=anchor
        )
        self._marks.append(label)

    def _erase(self) -> None:
        for mark in self._marks:
            mark.remove()
        self._marks.clear()


def piece_colours(answer: PathAnswer) -> Bytes:
    """Colours [P, 3] of the pieces: of their clearance, or of what stops the robot there."""
    pieces = answer.pieces
    colours = distance_colours(pieces.clearance_m, ~pieces.meets_unknown, answer.reach_m)
    colours[pieces.blocked] = np.round(255.0 * np.array(to_rgb(BEHIND)))
    return colours


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
