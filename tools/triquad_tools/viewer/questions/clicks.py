"""Clicks into a scene: they query the map at a point, or along a path of several."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import viser

from triquad_tools.viewer.page.legends import text_html
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.questions.path import Path
from triquad_tools.viewer.questions.picking import surface_along
from triquad_tools.viewer.questions.point import MAX_DISTANCE_M, Point
from triquad_tools.viewer.questions.question import Answer, Question

_ASKS, _LAYS, _NOTHING = "asks the map", "adds to the path", "does nothing"
_RAISED_M, _RADIUS_M = 0.5, 0.3
_LEAST_LEG_M = 0.01  # a second click at the same place adds nothing
_HINT = "Click at a surface."
_SKY = "No surface there: sky, or nothing was seen in that direction."


@dataclass(frozen=True)
class Clicked:
    """The points that were clicked at, one at least, and a robot that moves along them."""

    points: tuple[Point, ...]
    radius_m: float
    sky: bool  # whether the newest click met no surface


class Clicks(Question[Clicked]):
    """Shows what the map answers at the newest point, and about the path through all."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Clicks")
        self._events: deque[viser.SceneClickEvent] = deque()
        self._points: tuple[Point, ...] = ()
        self._sky = False
        self.hint = _HINT
        gui = page.gui
        with self.folder:
            self._use = gui.add_dropdown("A click", (_ASKS, _LAYS, _NOTHING))
            self._raised = gui.add_number("Raised by (m)", _RAISED_M, min=0.0, max=100.0, step=0.05)
            self._radius = gui.add_number("Radius (m)", _RADIUS_M, min=0.0, max=50.0, step=0.05)
            self._undo = gui.add_button("Undo last point")
            self._clear = gui.add_button("Clear path")
            self.add_text(text_html(_HINT))
        self._undo.on_click(lambda _: self._keep(self._points[:-1]))
        self._clear.on_click(lambda _: self._keep(()))
        page.scene.on_click()(self._clicked)
        self.start(self._use, self._radius)

    def close(self) -> None:
        """Listen and draw no more; remove what was drawn and the folder."""
        self.page.scene.remove_click_callback(self._clicked)
        super().close()

    def wanted(self) -> Clicked | None:
        """Find what was clicked at, and return it with all before, if there is anything."""
        for control in (self._radius, self._undo, self._clear):
            control.visible = self._use.value == _LAYS or len(self._points) > 1
        while self._events:
            self._find(self._events.popleft())
        self.hint = _SKY if self._sky else _HINT
        clicked = Clicked(self._points, float(self._radius.value), self._sky)
        return clicked if self._points else None

    def ask(self, wanted: Clicked) -> Answer:
        """Ask at the newest point, and about the path if there are several."""
        queries, point = self.page.source.queries, wanted.points[-1]
        told = text_html(_SKY) if wanted.sky else ""
        found = queries.query_distance(point.place[None], MAX_DISTANCE_M)
        if len(wanted.points) == 1:
            html, marks = told + point.html(found), point.marks(self, found)
            return Answer(html, found.epoch, marks)
        places = np.array([each.place for each in wanted.points])
        path = Path(queries, places, wanted.radius_m)
        html = told + path.html() + point.html(found)
        return Answer(html, found.epoch, path.marks(self) + point.marks(self, found))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self._use.value != _NOTHING:
            self._events.append(event)
            self.wake()

    def _keep(self, points: tuple[Point, ...]) -> None:
        self._points, self._sky = points, False
        self.wake()

    def _find(self, event: viser.SceneClickEvent) -> None:
        origin = self.page.in_map(np.array(event.ray_origin))
        surface = surface_along(self.page, origin, np.array(event.ray_direction))
        self._sky = surface is None
        before = self._points if self._use.value == _LAYS else ()
        if surface is None:
            self._points = before
            return
        point = Point(tuple(surface.tolist()), float(self._raised.value))
        if not before or np.linalg.norm(point.place - before[-1].place) > _LEAST_LEG_M:
            before += (point,)
        self._points = before
