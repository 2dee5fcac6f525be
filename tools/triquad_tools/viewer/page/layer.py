"""Parts of a page: controls, what they draw, and a thread that keeps it up to date."""

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
import viser
from triquad_client.calls.queries import MapQueries
from triquad_format.errors import TriquadError

from triquad_tools.viewer.page.legends import Legend
from triquad_tools.viewer.page.page import Page

_log = logging.getLogger(__name__)

_LEAST_S = 0.05  # between one refresh and the next, however often it is woken
_LEAST_ASKED_S, _SHARE = 2.0, 0.1  # between the same questions; of the time that goes with them


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
        self._answered: Hashable = None  # what is drawn, of which epoch
        self._epoch = 0
        self._began_s = self._due_s = 0.0
        self._woken, self._stopped = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

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
        self.erase()
        self.folder.remove()

    @abstractmethod
    def refresh(self) -> None:
        """Bring scene and panel up to date."""

    def outdated(self, wanted: Hashable) -> bool:
        """Return whether to ask: for something else than before, or of a newer epoch.

        The same is asked again only once it took no more than a tenth of the time.
        """
        self._began_s = time.monotonic()
        if wanted != self._answered:
            return True
        queries = self.page.source.queries
        return self._began_s > self._due_s and newest_epoch(queries) != self._epoch

    def answered(self, wanted: Hashable, epoch: int) -> None:
        """Record that what was :meth:`outdated` is up to date."""
        self._answered, self._epoch = wanted, epoch
        now_s = time.monotonic()
        self._due_s = now_s + max(_LEAST_ASKED_S, (now_s - self._began_s) / _SHARE)

    @property
    def drawn(self) -> bool:
        """Whether anything is drawn."""
        return bool(self._marks)

    def node(self, name: str) -> str:
        """Return a name for a node of the scene that no other has."""
        self._nodes += 1
        return f"/{self.name}/{self._nodes}/{name}"

    def draw(self, marks: Sequence[viser.SceneNodeHandle], legend: Legend | None = None) -> None:
        """Draw these marks in the scene instead of those drawn before."""
        before, self._marks = self._marks, list(marks)
        for mark in before:
            mark.remove()
        self.page.legends.pop(self.name, None)
        if legend is not None:
            self.page.legends[self.name] = legend

    def erase(self) -> None:
        """Draw nothing; whatever is wanted next is asked for."""
        self._answered = None
        self.draw([])

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


def newest_epoch(queries: MapQueries) -> int:
    """Return the number of the map's newest epoch, a published state; raises as its queries."""
    return queries.query_sdf(np.zeros((0, 3))).epoch
