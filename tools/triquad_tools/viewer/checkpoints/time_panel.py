"""Which checkpoint of a store a page shows."""

from triquad_format.errors import TriquadError

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import problem_html, text_html
from triquad_tools.viewer.page.refresher import Refresher
from triquad_tools.viewer.sources.history import Moment
from triquad_tools.viewer.sources.history_source import HistorySource

_PERIOD_S = 1.0
_PREVIOUS, _NEXT = "◀ Previous", "Next ▶"


class TimePanel:
    """A slider over the checkpoints of a store, to which a server may add."""

    def __init__(self, source: HistorySource, page: Page) -> None:
        self._source = source
        self._moments: tuple[Moment, ...] = ()
        self._wanted = source.moment
        self._folder = page.gui.add_folder("Time")
        with self._folder:
            self._slider = page.gui.add_slider("Checkpoint", 1, 1, 1, 1)
            self._buttons = page.gui.add_button_group("", (_PREVIOUS, _NEXT))
            self._text = page.gui.add_html("")
            self._damaged = page.gui.add_html("")
        self._offer(source.history.moments)
        self._refresher = Refresher("time", self._refresh, period_s=_PERIOD_S, failed=page.failed)
        self._slider.on_update(lambda _: self._want(self._slider.value))
        self._buttons.on_click(lambda _: self._step(-1 if self._buttons.value == _PREVIOUS else 1))

    def close(self) -> None:
        """Choose no more; the folder goes."""
        self._refresher.close()
        self._folder.remove()

    def _want(self, number: int) -> None:
        """Have the moment of this number shown, counted from 1."""
        moments = self._moments
        if 1 <= number <= len(moments):
            self._wanted = moments[number - 1]
            self._refresher.wake()

    def _step(self, by: int) -> None:
        self._slide_to(self._slider.value + by)

    def _slide_to(self, number: int) -> None:
        chosen = max(min(number, len(self._moments)), 1)
        self._slider.value = chosen  # type: ignore[misc] # viser has a setter that mypy overlooks

    def _refresh(self) -> None:
        self._source.history.refresh()
        self._offer(self._source.history.moments)
        wanted = self._wanted
        if wanted == self._source.moment:
            return
        self._text.content = text_html(f"opening {wanted} …")
        try:
            self._source.move(wanted)
        except TriquadError:
            if self._wanted == wanted:
                self._slide_to(self._place_of(self._source.moment))
            raise
        finally:
            self._tell()

    def _offer(self, moments: tuple[Moment, ...]) -> None:
        """Have all that there are on the slider, which stays where it is in time."""
        damaged = problem_html("\n".join(self._source.history.damaged))
        if self._damaged.content != damaged:
            self._damaged.content = damaged
        if not moments:
            raise ToolError("the store has no checkpoint left that can be shown")
        if moments != self._moments:
            self._moments = moments
            self._slider.max = len(moments)
            self._slide_to(self._place_of(self._wanted))
            self._tell()

    def _place_of(self, moment: Moment) -> int:
        """Its number on the slider, or that of the one before where it is gone."""
        return sum(one.epoch <= moment.epoch for one in self._moments)

    def _tell(self) -> None:
        shown = self._source.moment
        place = f"{self._place_of(shown)} of {len(self._moments)}"
        if shown not in self._moments:
            place = "no longer in the store"
        self._text.content = text_html(f"{shown}\n{place}")
