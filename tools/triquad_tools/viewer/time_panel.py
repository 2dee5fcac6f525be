"""The choice of the checkpoint that a page shows."""

from triquad_format.errors import TriquadError

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import problem_html, text_html
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.sources.history import History, Moment
from triquad_tools.viewer.sources.stored_source import StoredSource

_PERIOD_S = 1.0
_PREVIOUS, _NEXT = "◀ Previous", "Next ▶"


class TimePanel(Layer):
    """A slider over the checkpoints of a store, to which a server may add."""

    def __init__(self, history: History, source: StoredSource, page: Page) -> None:
        super().__init__(page, "Time", _PERIOD_S)
        self._history, self._source = history, source
        self._moments: tuple[Moment, ...] = ()
        self._wanted = source.shown.path
        with self.folder:
            self._slider = page.gui.add_slider("Checkpoint", 1, 1, 1, 1)
            self._buttons = page.gui.add_button_group("", (_PREVIOUS, _NEXT))
            self._text = page.gui.add_html("")
        self._slider.on_update(lambda _: self._want(self._slider.value))
        self._buttons.on_click(
            lambda _: self._slide_to(self._slider.value + (-1, 1)[self._buttons.value == _NEXT])
        )
        self.start()

    def refresh(self) -> None:
        """Add new checkpoints, and show the one that is wanted."""
        self._history.refresh()
        moments = self._history.moments
        if not moments:
            raise ToolError("the store has no checkpoint left that can be shown")
        if moments != self._moments:  # the slider stays where it is in time
            self._moments = moments
            self._slider.max = len(moments)
            self._slide_to(self._place_of_shown())
        wanted = next((moment for moment in moments if moment.path == self._wanted), None)
        try:
            if wanted is not None and self._wanted != self._source.shown.path:
                self._text.content = text_html(f"opening {wanted} …")
                self._source.show(self._history.opened(wanted))
        except TriquadError:
            self._slide_to(self._place_of_shown())
            raise
        finally:
            self._tell()

    def _want(self, number: int) -> None:
        """Show the moment of this number, counted from 1."""
        moments = self._moments
        if 1 <= number <= len(moments):
            self._wanted = moments[number - 1].path
            self.wake()

    def _slide_to(self, number: int) -> None:
        chosen = max(min(number, len(self._moments)), 1)
        self._slider.value = chosen  # type: ignore[misc] # viser has a setter that mypy overlooks
        self._want(chosen)

    def _place_of_shown(self) -> int:
        """Return the slider's number of what is shown, or of the one before if it was deleted."""
        epoch = self._source.state().epoch
        return sum(moment.epoch <= epoch for moment in self._moments)

    def _tell(self) -> None:
        place = "no longer in the store"
        for moment in self._moments:
            if moment.path == self._source.shown.path:
                place = f"{moment}\n{self._place_of_shown()} of {len(self._moments)}"
        content = text_html(place) + problem_html("\n".join(self._history.damaged))
        if self._text.content != content:
            self._text.content = content
