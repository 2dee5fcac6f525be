"""What appeared, vanished and moved between two checkpoints: boxes in the scene, and a list."""

from typing import NamedTuple

from triquad_tools.mapfiles.diff import compare
from triquad_tools.mapfiles.object_changes import ObjectChanges, object_changes
from triquad_tools.viewer.checkpoints.changes_drawing import (
    APPEARED,
    MOVED,
    VANISHED,
    ChangesDrawing,
)
from triquad_tools.viewer.checkpoints.changes_text import changes_text
from triquad_tools.viewer.page.legends import Legend, LineMeaning
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import text_html
from triquad_tools.viewer.page.refresher import Refresher
from triquad_tools.viewer.sources.history import Moment
from triquad_tools.viewer.sources.history_source import HistorySource

_PERIOD_S = 1.0
_BEFORE = "the checkpoint before"
_NOTHING = "There is no checkpoint before this one: choose another to compare with."


class Between(NamedTuple):
    """Two moments that are compared."""

    before: Moment
    after: Moment


class ChangesPanel:
    """Shows on request what changed up to the checkpoint that a page shows."""

    def __init__(self, source: HistorySource, page: Page) -> None:
        self._source = source
        self._page = page
        self._compared: Between | None = None
        self._drawing = ChangesDrawing(page)
        self._folder = page.gui.add_folder("What changed")
        with self._folder:
            self._on = page.gui.add_checkbox("Show changes", False)
            self._since = page.gui.add_dropdown("Since", (_BEFORE,))
            self._text = page.gui.add_html("")
        self._refresher = Refresher(
            "changes", self._refresh, period_s=_PERIOD_S, failed=page.failed
        )
        for control in (self._on, self._since):
            control.on_update(lambda _: self._refresher.wake())

    def close(self) -> None:
        """Draw no more; what was drawn and the folder go."""
        self._refresher.close()
        self._clear()
        self._folder.remove()

    def _refresh(self) -> None:
        moments = self._source.history.moments
        options = (_BEFORE, *map(str, reversed(moments)))
        if self._since.options != options:
            self._since.options = options
        shown = self._source.moment
        other = self._other(shown, moments)
        between = None
        if self._on.value and other is not None and other != shown:
            between = Between(*sorted((other, shown), key=lambda moment: moment.epoch))
        if between is None:
            self._clear(_NOTHING if self._on.value else "")
        elif between != self._compared:
            self._clear(f"comparing epochs {between.before.epoch} and {between.after.epoch} …")
            self._draw(between, self._changes(between))
        self._compared = between

    def _other(self, shown: Moment, moments: tuple[Moment, ...]) -> Moment | None:
        """With what the moment that is shown is compared."""
        if self._since.value == _BEFORE:
            earlier = [moment for moment in moments if moment.epoch < shown.epoch]
            return earlier[-1] if earlier else None
        return next((one for one in moments if str(one) == self._since.value), None)

    def _changes(self, between: Between) -> ObjectChanges:
        history = self._source.history
        with history.using(between.before) as old, history.using(between.after) as new:
            return object_changes(compare(old.opened, new.opened))

    def _draw(self, between: Between, found: ObjectChanges) -> None:
        self._drawing.draw(found)
        legend = _legend(between)
        self._page.legends.show("changes", legend)
        self._text.content = (
            text_html(_heading(between)) + legend.html + text_html(changes_text(found))
        )

    def _clear(self, text: str = "") -> None:
        self._drawing.erase()
        self._page.legends.hide("changes")
        content = text_html(text) if text else ""
        if self._text.content != content:
            self._text.content = content


def _legend(between: Between) -> Legend:
    before, after = between.before.epoch, between.after.epoch
    lines = (
        LineMeaning(APPEARED, False, f"appeared (A): free space in epoch {before}"),
        LineMeaning(VANISHED, True, f"vanished (V): free space in epoch {after}"),
        LineMeaning(MOVED, False, "moved (M): dashed before, solid after"),
    )
    return Legend(lines=lines)


def _heading(between: Between) -> str:
    return f"From {between.before}\nto {between.after}:"
