"""Clicks into a scene: they query the map at a point, or add to a path for a robot."""

from queue import Empty, SimpleQueue

import numpy as np
import viser
from triquad_format.errors import TriquadError

from triquad_tools.viewer.asking.path import LEGEND, ask_path, path_html, path_marks
from triquad_tools.viewer.asking.picking import surface_along
from triquad_tools.viewer.asking.point import AskedPoint, ask_point, point_html, point_marks
from triquad_tools.viewer.page.layer import Layer, newest_epoch
from triquad_tools.viewer.page.legends import text_html
from triquad_tools.viewer.page.page import Page

_PERIOD_S = 0.5
_ASKS, _LAYS, _NOTHING = "asks the map", "adds to the path", "does nothing"
_RAISED_M, _RADIUS_M = 0.5, 0.3
_LEAST_LEG_M = 0.01  # a second click at the same place adds nothing
_SKY = "No surface there: sky, or nothing was seen in that direction."
_UNANSWERED = text_html("The map does not answer about this point or path.")


class ClickLayer(Layer):
    """Queries the map at what is clicked, and again as the map changes."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Clicks", _PERIOD_S)
        self._clicks: SimpleQueue[viser.SceneClickEvent] = SimpleQueue()
        self._point: AskedPoint | None = None
        self._path: tuple[AskedPoint, ...] = ()
        self._sky = False  # the newest click met no surface
        gui = page.gui
        with self.folder:
            self._use = gui.add_dropdown("A click", (_ASKS, _LAYS, _NOTHING))
            self._raised = gui.add_number("Raised by (m)", _RAISED_M, min=0.0, max=100.0, step=0.05)
            self._radius = gui.add_number("Radius (m)", _RADIUS_M, min=0.0, max=50.0, step=0.05)
            self._undo = gui.add_button("Undo last point")
            self._clear = gui.add_button("Clear path")
            self._text = gui.add_html("")
        self._undo.on_click(lambda _: self._lay(self._path[:-1]))
        self._clear.on_click(lambda _: self._lay(()))
        page.scene.on_click()(self._clicked)
        self.start(self._use, self._radius)

    def close(self) -> None:
        """Listen and draw no more; remove what was drawn and the folder."""
        self.page.scene.remove_click_callback(self._clicked)
        super().close()

    def refresh(self) -> None:
        """Find what was clicked at, and ask if a point, the path or the map has changed."""
        for control in (self._radius, self._undo, self._clear):
            control.visible = self._use.value == _LAYS or bool(self._path)
        while True:
            try:
                self._find(self._clicks.get_nowait())
            except Empty:
                break
        wanted = (self._use.value, self._point, self._path, self._radius.value, self._sky)
        if not self.outdated(wanted):
            return
        epoch = newest_epoch(self.page.source.queries)
        try:
            self._ask(self._point, self._path, float(self._radius.value))
        except TriquadError:
            # What is drawn was true of another point or radius, or of another map.
            self._text.content = _UNANSWERED
            self.draw([])
            raise
        self.answered(wanted, epoch)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self._use.value != _NOTHING:
            self._clicks.put(event)
            self.wake()

    def _lay(self, path: tuple[AskedPoint, ...]) -> None:
        self._path = path
        self.wake()

    def _find(self, event: viser.SceneClickEvent) -> None:
        origin = self.page.in_map(np.array(event.ray_origin))
        surface = surface_along(self.page, origin, np.array(event.ray_direction))
        self._sky = surface is None
        point = None
        if surface is not None:
            point = AskedPoint(tuple(surface.tolist()), float(self._raised.value))
        if self._use.value != _LAYS:
            self._point = point
        elif point is not None and not (
            self._path and np.linalg.norm(point.place - self._path[-1].place) < _LEAST_LEG_M
        ):
            self._path += (point,)

    def _ask(self, point: AskedPoint | None, path: tuple[AskedPoint, ...], radius_m: float) -> None:
        """Show and draw what the map answers about a point and a path."""
        queries, points = self.page.source.queries, [asked.place for asked in path]
        laid = ask_path(queries, points, radius_m) if len(points) > 1 else None
        told = text_html(_SKY) if self._sky else ""
        marks = path_marks(self, points, radius_m, laid)
        if point is not None:
            answer = ask_point(queries, point)
            told += point_html(point, answer)
            marks += point_marks(self, point, answer)
        if laid is not None:
            told += path_html(len(points), radius_m, laid) + LEGEND.html
        elif self._use.value == _LAYS:
            how = "One point: click at the next." if points else "Click at the first point."
            told += text_html(how)
        self._text.content = told or text_html("Click at a surface.")
        self.draw(marks, None if laid is None else LEGEND)
