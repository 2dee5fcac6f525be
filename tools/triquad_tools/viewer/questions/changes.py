"""Objects that appeared or vanished between checkpoints: boxes in the scene."""

from collections.abc import Iterator

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_format.records.arrays import Doubles

from triquad_tools.mapfiles.diff import compare
from triquad_tools.mapfiles.object_changes import (
    LEAST_POINTS,
    ObjectChanges,
    object_changes,
)
from triquad_tools.viewer.page.legends import lines_html, text_html
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.questions.question import Answer, Question, newest_epoch
from triquad_tools.viewer.sources.history import History, Moment

_BEFORE = "the checkpoint before"
_NOTHING = "There is no checkpoint before this one: choose another to compare with."

# Okabe and Ito's colours, which all can distinguish, that stand out on mesh and background.
APPEARED, VANISHED = "#56b4e9", "#d55e00"
_MOST = 50  # of each kind are drawn
_ASIDE_M = 0.1  # outlines lie this far outside of what they surround
_LINE_PX = 3.0
_CORNERS = np.array(list(np.ndindex(2, 2, 2)))
_EDGES = np.argwhere(np.triu(np.abs(_CORNERS[:, None] - _CORNERS).sum(axis=2) == 1))

Pair = tuple[Moment, Moment]
"""What is compared, the earlier one first."""


class Changes(Question[Pair]):
    """Shows on request what changed up to the checkpoint that a page shows."""

    def __init__(self, page: Page, history: History) -> None:
        super().__init__(page, "What changed")
        self._history = history
        with self.folder:
            self._on = page.gui.add_checkbox("Show changes", False)
            self._since = page.gui.add_dropdown("Since", (_BEFORE,))
            self.add_text()
        self.start(self._on, self._since)

    def wanted(self) -> Pair | None:
        """Return the checkpoint that is shown, and the one to compare it with."""
        moments, epoch = self._history.moments, newest_epoch(self.page.source.queries)
        options = (_BEFORE, *map(str, reversed(moments)))
        if self._since.options != options:
            self._since.options = options
        shown = [one for one in moments if one.epoch == epoch]
        if self._since.value == _BEFORE:
            others = [one for one in moments if one.epoch < epoch][-1:]
        else:
            others = [one for one in moments if str(one) == self._since.value and one not in shown]
        self.hint = _NOTHING if self._on.value else ""
        if not (self._on.value and shown and others):
            return None
        before, after = sorted([*shown, *others], key=lambda moment: moment.epoch)
        return before, after

    def ask(self, wanted: Pair) -> Answer:
        """Compare two checkpoints."""
        before, after = wanted
        self.tell(text_html(f"comparing epochs {before.epoch} and {after.epoch} …"))
        old, new = (self._history.opened(moment).queries for moment in wanted)
        found = object_changes(compare(old, new))
        html = lines_html(
            (APPEARED, f"{len(found.appeared)} appeared (A): free space in epoch {before.epoch}"),
            (VANISHED, f"{len(found.vanished)} vanished (V): free space in epoch {after.epoch}"),
        ) + text_html(
            f"From {before}\nto {after}.\nnewly seen: {len(found.newly_seen)}, no longer known: "
            f"{len(found.no_longer_known)} (not drawn: one of the two has never been there)\n"
            f"What has fewer than {LEAST_POINTS} voxels is left out."
        )
        return Answer(html, newest_epoch(self.page.source.queries), list(self._marks_of(found)))

    def _marks_of(self, found: ObjectChanges) -> Iterator[viser.SceneNodeHandle]:
        """Draw boxes with names."""
        kinds = (
            ("A{}", APPEARED, found.appeared),
            ("V{}", VANISHED, found.vanished),
        )
        for name, colour, clusters in kinds:
            for number, cluster in enumerate(clusters[:_MOST], start=1):
                corners = cluster.middle_m + (_CORNERS - 0.5) * (cluster.size_m + 2 * _ASIDE_M)
                yield self._lines(corners[_EDGES], colour)
                size = " × ".join(f"{side:.1f}" for side in cluster.size_m)
                text, top = f"{name.format(number)}: {size} m", corners[[0, -1]].mean(axis=0)
                top[2] = corners[-1, 2] + _ASIDE_M
                yield self.page.scene.add_label(
                    self.node("name"), text, position=self.page.in_scene(top)
                )

    def _lines(self, lines: Doubles, colour: str) -> viser.SceneNodeHandle:
        """Draw lines [L, 2, 3], metres, map frame."""
        return self.page.scene.add_line_segments(
            self.node("lines"), self.page.in_scene(lines), np.array(to_rgb(colour)),
            thickness=_LINE_PX, thickness_units="screen",
        )  # fmt: skip
