"""Objects that appeared or vanished between checkpoints: boxes in the scene, and a list."""

from collections.abc import Sequence

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_format.records.arrays import Doubles

from triquad_tools.mapfiles.diff import compare
from triquad_tools.mapfiles.object_changes import (
    LEAST_POINTS,
    Cluster,
    ObjectChanges,
    object_changes,
)
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import Legend, LineMeaning, text_html
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.sources.history import History, Moment
from triquad_tools.viewer.sources.stored_source import StoredSource

_PERIOD_S = 1.0
_BEFORE = "the checkpoint before"
_NOTHING = "There is no checkpoint before this one: choose another to compare with."

# Okabe and Ito's colours, which all can distinguish, that stand out on mesh and background.
APPEARED, VANISHED = "#56b4e9", "#d55e00"
_LISTED, _MOST = 5, 50  # of each kind are in the list, and in the scene
_ASIDE_M = 0.1  # outlines lie this far outside of what they surround
_DASH_SHARE = 0.6  # of a dash and a gap together
_LINE_PX = 3.0
_CORNERS = np.array(list(np.ndindex(2, 2, 2)))
_EDGES = np.argwhere(np.triu(np.abs(_CORNERS[:, None] - _CORNERS).sum(axis=2) == 1))


class ChangesPanel(Layer):
    """Shows on request what changed up to the checkpoint that a page shows."""

    def __init__(self, history: History, source: StoredSource, page: Page) -> None:
        super().__init__(page, "What changed", _PERIOD_S)
        self._history, self._source = history, source
        self._compared: tuple[Moment, ...] = ()
        with self.folder:
            self._on = page.gui.add_checkbox("Show changes", False)
            self._since = page.gui.add_dropdown("Since", (_BEFORE,))
            self._text = page.gui.add_html("")
        self.start(self._on, self._since)

    def refresh(self) -> None:
        """Compare if another pair of checkpoints is wanted."""
        moments = self._history.moments
        options = (_BEFORE, *map(str, reversed(moments)))
        if self._since.options != options:
            self._since.options = options
        pair = self._pair(moments) if self._on.value else ()
        if pair and pair == self._compared:
            return
        self.erase()
        self._compared = ()
        self._tell("" if pair or not self._on.value else _NOTHING)
        if pair:
            before, after = pair
            self._tell(f"comparing epochs {before.epoch} and {after.epoch} …")
            old, new = self._history.opened(before), self._history.opened(after)
            self._draw(before, after, object_changes(compare(old.opened, new.opened)))
        self._compared = pair

    def _pair(self, moments: Sequence[Moment]) -> tuple[Moment, ...]:
        """Return the two that are compared, the earlier one first; empty: there are no two."""
        shown = [one for one in moments if one.path == self._source.shown.path]
        if self._since.value == _BEFORE:
            others = [one for one in moments if shown and one.epoch < shown[0].epoch][-1:]
        else:
            others = [one for one in moments if str(one) == self._since.value and one not in shown]
        pair = tuple(sorted([*shown, *others], key=lambda moment: moment.epoch))
        return pair if len(pair) == 2 else ()

    def _draw(self, before: Moment, after: Moment, found: ObjectChanges) -> None:
        legend = Legend(
            lines=(
                LineMeaning(APPEARED, f"appeared (A): free space in epoch {before.epoch}"),
                LineMeaning(VANISHED, f"vanished (V): free space in epoch {after.epoch}", "dashed"),
            )
        )
        marks: list[viser.SceneNodeHandle] = []
        for name, colour, cluster in _boxes(found):
            lines = outline(cluster)
            marks.append(self._lines(dashes(lines) if colour == VANISHED else lines, colour))
            top = cluster.middle_m + [0, 0, cluster.size_m[2] / 2 + 2 * _ASIDE_M]
            place = self.page.in_scene(top)
            marks.append(self.page.scene.add_label(self.node("name"), name, position=place))
        self.draw(marks, legend)
        self._tell(f"From {before}\nto {after}:", legend.html + text_html(_list(found)))

    def _lines(self, lines: Doubles, colour: str) -> viser.SceneNodeHandle:
        """Draw lines [L, 2, 3], metres, map frame."""
        return self.page.scene.add_line_segments(
            self.node("lines"), self.page.in_scene(lines), np.array(to_rgb(colour)),
            thickness=_LINE_PX, thickness_units="screen",
        )  # fmt: skip

    def _tell(self, text: str, html: str = "") -> None:
        content = (text_html(text) if text else "") + html
        if self._text.content != content:
            self._text.content = content


def outline(cluster: Cluster) -> Doubles:
    """Return the edges [12, 2, 3] of a box around a cluster, a little outside of it."""
    low, high = np.array(cluster.low_m) - _ASIDE_M, np.array(cluster.high_m) + _ASIDE_M
    return np.asarray((low + _CORNERS * (high - low))[_EDGES], np.float64)


def dashes(lines: Doubles) -> Doubles:
    """Return lines [L, 2, 3] cut into four dashes each."""
    starts = np.arange(4)[:, None, None] / 4
    lows, ways = lines[:, :1], np.diff(lines, axis=1)
    begun = lows[None] + starts[..., None] * ways[None]
    return np.concatenate([begun, begun + ways[None] * _DASH_SHARE / 4], axis=2).reshape(-1, 2, 3)


def _boxes(found: ObjectChanges) -> list[tuple[str, str, Cluster]]:
    """Return name, colour and place of what is drawn as a box."""
    kinds = (
        ("A{}", APPEARED, found.appeared),
        ("V{}", VANISHED, found.vanished),
    )
    return [
        (name.format(number), colour, cluster)
        for name, colour, clusters in kinds
        for number, cluster in enumerate(clusters[:_MOST], start=1)
    ]


def _list(found: ObjectChanges) -> str:
    """Return how much changed, and the largest things by name, size and place."""
    kinds = (("appeared", found.appeared), ("vanished", found.vanished))
    lines = []
    for kind, clusters in kinds:
        lines.append(f"{len(clusters)} {kind}")
        for number, cluster in enumerate(clusters[:_LISTED], start=1):
            size = " × ".join(f"{side:.1f}" for side in cluster.size_m)
            place = ", ".join(f"{value:.1f}" for value in cluster.middle_m)
            name = f"{kind[0].upper()}{number}"
            lines.append(f"  {name}: {cluster.points:,} voxels, {size} m, at {place}")
    lines.append(
        f"newly seen: {len(found.newly_seen)}, no longer known: {len(found.no_longer_known)} "
        "(not drawn: one of the two has never been there)"
    )
    return "\n".join([*lines, f"things of fewer than {LEAST_POINTS} voxels are left out"])
