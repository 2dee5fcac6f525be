"""Clicks into a scene: they ask the map at a point, or lay a path."""

from collections.abc import Callable
from functools import partial
from queue import Empty, SimpleQueue

import numpy as np
from viser import SceneClickEvent

from triquad_tools.viewer.asking.path_probe import PathProbe
from triquad_tools.viewer.asking.picking import surface_along
from triquad_tools.viewer.asking.point_probe import PointProbe
from triquad_tools.viewer.asking.questions import Pace
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.refresher import Refresher

_PERIOD_S = 0.5
_ASKS, _LAYS, _NOTHING = "asks the map", "adds to the path", "does nothing"
_RAISED_M = 0.5


class ClickLayer:
    """Finds the surface that is clicked at, and hands it to what a click is for."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._pace = Pace()
        self._todo: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._folder = page.gui.add_folder("Clicks")
        with self._folder:
            self._use = page.gui.add_dropdown("A click", (_ASKS, _LAYS, _NOTHING))
            self._raised = page.gui.add_number(
                "Raised by (m)", _RAISED_M, min=0.0, max=100.0, step=0.05
            )
            self._point = PointProbe(page)
            self._path = PathProbe(page, self._do)
        self._refresher = Refresher("clicks", self._refresh, period_s=_PERIOD_S, failed=page.failed)
        self._use.on_update(lambda _: self._refresher.wake())
        page.scene.on_click()(self._clicked)

    def close(self) -> None:
        """Listen and draw no more; what was drawn and the folder go."""
        self._page.scene.remove_click_callback(self._clicked)
        self._refresher.close()
        self._point.clear()
        self._path.clear()
        self._folder.remove()

    def _clicked(self, event: SceneClickEvent) -> None:
        if self._use.value != _NOTHING:
            self._do(partial(self._find, event))

    def _do(self, task: Callable[[], None]) -> None:
        """Have something done on the thread that alone changes points and paths."""
        self._todo.put(task)
        self._refresher.wake()

    def _refresh(self) -> None:
        self._path.show_controls(self._use.value == _LAYS)
        while True:
            try:
                self._todo.get_nowait()()
            except Empty:
                break
        if self._pace.due or self._point.unanswered or self._path.unanswered:
            with self._pace.asking():
                self._point.refresh()
                self._path.refresh()

    def _find(self, event: SceneClickEvent) -> None:
        origin = self._page.in_map(np.array(event.ray_origin))
        surface = surface_along(self._page, origin, np.array(event.ray_direction))
        if self._use.value == _LAYS:
            self._path.add(surface, self._raised.value)
        else:
            self._point.put(surface, self._raised.value)
