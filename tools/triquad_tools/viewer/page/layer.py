"""Parts of a page: controls, what they draw, and a thread that keeps it up to date."""

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import viser
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from triquad_format.errors import TriquadError

from triquad_tools.viewer.page.page import Page

_log = logging.getLogger(__name__)

_LEAST_S = 0.05  # between one refresh and the next, however often it is woken


class Layer(ABC):
    """Shows one thing of a map in scene and panel, until it is closed.

    :meth:`refresh` is called on a thread of its own: whenever it is woken, and after each period.
    Where it raises, the page says so, and it is tried again after the period.
    """

    def __init__(self, page: Page, name: str, period_s: float) -> None:
        self.page = page
        self.name = name
        self.folder = page.gui.add_folder(name)
        self._period_s = period_s
        self._marks: list[viser.SceneNodeHandle] = []
        self._nodes = 0  # that were named so far
        self._woken, self._stopped = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def add_text(self, html: str = "") -> None:
        """Add the layer's text to the panel, below the controls that are there."""
        self._text = self.page.gui.add_html(html)

    def tell(self, html: str) -> None:
        """Show a text in place of the one before."""
        if self._text.content != html:
            self._text.content = html

    def start(self, *controls: "viser.GuiInputHandle[Any]") -> None:
        """Begin to refresh; changes of the controls wake it."""
        for control in controls:
            control.on_update(self.wake)
        self._thread.start()

    def wake(self, _: object = None) -> None:
        """Refresh soon."""
        self._woken.set()

    def close(self) -> None:
        """Draw no more, once a refresh that is under way ends; what was drawn and the folder go."""
        self._stopped.set()
        self._woken.set()
        self._thread.join()
        self.draw([])
        self.folder.remove()

    @abstractmethod
    def refresh(self) -> None:
        """Bring scene and panel up to date."""

    def node(self, name: str) -> str:
        """Return a name for a node of the scene that no other has."""
        self._nodes += 1
        return f"/{self.name}/{self._nodes}/{name}"

    def lines(
        self,
        pieces: NDArray[np.floating],
        colour: str,
        thickness: float,
        units: Literal["world", "screen"] = "world",
    ) -> viser.SceneNodeHandle:
        """Return pieces of lines [L, 2, 3], metres, map frame, as a mark of a colour."""
        return self.page.scene.add_line_segments(
            self.node("lines"), self.page.in_scene(pieces), np.array(to_rgb(colour)),
            thickness=thickness, thickness_units=units,
        )  # fmt: skip

    def draw(self, marks: Sequence[viser.SceneNodeHandle]) -> None:
        """Draw these marks in the scene; those drawn before go, unless they are among them."""
        before, self._marks = self._marks, list(marks)
        kept = {mark.name for mark in marks}
        for mark in before:
            if mark.name not in kept:
                mark.remove()

    def _run(self) -> None:
        failing = False
        while not self._stopped.is_set():
            self._woken.clear()
            problem = ""
            try:
                self.refresh()
            except TriquadError as error:
                problem = str(error)
            except Exception as error:
                _log.exception("%s failed", self.name)
                problem = f"{type(error).__name__}: {error}"
            if problem or failing:
                self.page.failed(self.name, problem)
            failing = bool(problem)
            self._stopped.wait(_LEAST_S)
            self._woken.wait(self._period_s)
