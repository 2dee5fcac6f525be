"""Which checkpoint of a store a page shows."""

from collections.abc import Callable

import viser

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.changes_panel import ChangesPanel
from triquad_tools.viewer.file_source import FileSource
from triquad_tools.viewer.history import History, Moment
from triquad_tools.viewer.panel import problem_html, text_html
from triquad_tools.viewer.refresher import Refresher
from triquad_tools.viewer.stage import SceneOrigin

_PERIOD_S = 1.0
_COARSE_S = 5.0  # after so long, a map is shown with what there is of its mesh
_PREVIOUS, _NEXT = "◀ Previous", "Next ▶"

Show = Callable[[FileSource], None]


class TimePanel:
    """A slider over the checkpoints of a store, and what changed up to the one that is shown."""

    def __init__(
        self,
        client: viser.ClientHandle,
        history: History,
        origin: SceneOrigin,
        *,
        show: Show,
        failed: Callable[[str], None],
    ) -> None:
        """``show`` shows a map, and ``failed`` what went wrong."""
        self._history = history
        self._show = show
        self._moments = history.moments
        self._shown: Moment | None = None
        self._wanted: Moment | None = None  # None: the newest
        self._folder = client.gui.add_folder("Time")
        with self._folder:
            count = max(len(self._moments), 1)
            self._slider = client.gui.add_slider("Checkpoint", 1, count, 1, count)
            self._buttons = client.gui.add_button_group("", (_PREVIOUS, _NEXT))
            self._text = client.gui.add_html("")
            self._damaged = client.gui.add_html("")
        self._changes = ChangesPanel(client, history, origin, failed=failed)
        self._refresher = Refresher("time", self._refresh, _PERIOD_S, failed)
        self._slider.on_update(lambda _: self._want(self._slider.value))
        self._buttons.on_click(lambda _: self._step(-1 if self._buttons.value == _PREVIOUS else 1))

    def close(self) -> None:
        """Choose no more; the map is not used any longer."""
        self._refresher.close()
        self._changes.close()
        if self._shown is not None:
            self._history.release(self._shown)
        self._folder.remove()

    def _want(self, number: int) -> None:
        """Show the moment of this number, counted from 1."""
        moments = self._moments
        if moments:
            self._wanted = moments[min(number, len(moments)) - 1]
            self._refresher.wake()

    def _step(self, by: int) -> None:
        self._slide_to(self._slider.value + by)

    def _slide_to(self, number: int) -> None:
        chosen = max(min(number, len(self._moments)), 1)
        self._slider.value = chosen  # type: ignore[misc] # viser has a setter that mypy overlooks

    def _refresh(self) -> None:
        self._history.refresh()
        self._offer(self._history.moments)
        if self._wanted is None:
            self._wanted = self._moments[-1]
        if self._wanted != self._shown:
            self._move(self._wanted)

    def _offer(self, moments: tuple[Moment, ...]) -> None:
        """Have all that there are on the slider, which stays where it is in time."""
        damaged = problem_html("\n".join(self._history.damaged))
        if self._damaged.content != damaged:
            self._damaged.content = damaged
        if not moments:
            raise ToolError("the store has no checkpoint left that can be shown")
        if moments != self._moments:
            kept = self._wanted or self._shown
            self._moments = moments
            self._slider.max = len(moments)
            if kept is not None:
                self._slide_to(sum(moment.epoch <= kept.epoch for moment in moments))
            self._changes.offer(moments)
            self._tell()

    def _move(self, moment: Moment) -> None:
        self._text.content = text_html(f"opening {moment} …")
        try:
            source = self._history.use(moment)
        except ToolError:
            if self._wanted == moment:
                self._wanted = self._shown
            self._tell()
            raise
        source.prepare(_COARSE_S)
        before, self._shown = self._shown, moment
        self._show(source)
        if before is not None:
            self._history.release(before)
        self._changes.offer(self._moments)
        self._changes.show(moment)
        self._tell()

    def _tell(self) -> None:
        shown = self._shown
        if shown is None:
            return
        place = sum(moment.epoch <= shown.epoch for moment in self._moments)
        self._text.content = text_html(f"{shown}\n{place} of {len(self._moments)}")
