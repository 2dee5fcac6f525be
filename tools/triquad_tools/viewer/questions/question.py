"""A question that a page asks a map, and asks again as the map or the question changes."""

import time
from abc import abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import viser
from triquad_client.calls.queries import MapQueries
from triquad_format.errors import TriquadError

from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import text_html
from triquad_tools.viewer.page.page import Page

_PERIOD_S = 0.5
_LEAST_ASKED_S, _SHARE = 2.0, 0.1  # between the same questions; of the time that goes with them

Wanted = TypeVar("Wanted", bound=Hashable)
"""All that an answer depends on, but for the map."""


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
        """Draw nothing."""
        self._answered = None
        self.tell(text_html(self.hint))
        self.draw([])


def newest_epoch(queries: MapQueries) -> int:
    """Return the number of the map's newest epoch, a published state; raises as its queries."""
    return queries.query_sdf(np.zeros((0, 3))).epoch
