"""Parts of a page, each with a thread that keeps it up to date, and questions to the map."""

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import viser
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from triquad_client.calls.queries import MapQueries
from triquad_format.errors import TriquadError

from triquad_tools.viewer.page.legends import text_html
from triquad_tools.viewer.page.page import Page

_log = logging.getLogger(__name__)

_LEAST_S = 0.05  # between one refresh and the next, however often it is woken

_PERIOD_S = 0.5
_LEAST_ASKED_S, _SHARE = 2.0, 0.1  # between the same questions; of the time that goes with them
Wanted = TypeVar("Wanted", bound=Hashable)  # all that an answer depends on, but for the map


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


@dataclass(frozen=True)
class Answer:
    """The answer to a question, for the panel and the scene."""

    html: str
    epoch: int  # of the map that gave it
    marks: Sequence[viser.SceneNodeHandle] = ()


class Question(Layer, Generic[Wanted]):
    """Shows the answer to a question as long as there is something to ask.

    The same is asked again where the map has a newer epoch, at most every two seconds and only once
    it took no more than a tenth of the time.
    """

    def __init__(self, page: Page, name: str) -> None:
        super().__init__(page, name, _PERIOD_S)
        self._answered: Hashable = None  # what is drawn
        self._epoch = 0
        self._due_s = 0.0
        self.hint = ""  # what the panel says while nothing is asked

    @abstractmethod
    def wanted(self) -> Wanted | None:
        """Return what is to be asked now; ``None``: nothing."""

    @abstractmethod
    def ask(self, wanted: Wanted) -> Answer:
        """Ask it, and draw the answer.

        Raises:
            TriquadError: the map does not answer.
        """

    def refresh(self) -> None:
        """Ask if the question or the map has changed."""
        wanted, source = self.wanted(), self.page.source
        if wanted is None:
            self._forget()
            return
        began_s, key = time.monotonic(), (source, wanted)
        if key == self._answered and (
            began_s < self._due_s or newest_epoch(source.queries) == self._epoch
        ):
            return
        try:
            answer = self.ask(wanted)
        except TriquadError:
            if key != self._answered:  # what is drawn was true of another question or map
                self._forget()
            raise
        ended_s = time.monotonic()
        self._answered, self._epoch = key, answer.epoch
        self._due_s = ended_s + max(_LEAST_ASKED_S, (ended_s - began_s) / _SHARE)
        self.draw(answer.marks)
        self.tell(answer.html)

    def _forget(self) -> None:
        self._answered = None
        self.tell(text_html(self.hint))
        self.draw([])


def newest_epoch(queries: MapQueries) -> int:
    """Return the number of the map's newest epoch, a published state; raises as its queries."""
    return queries.query_sdf(np.zeros((0, 3))).epoch
