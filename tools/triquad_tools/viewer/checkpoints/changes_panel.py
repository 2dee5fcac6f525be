"""What appeared, vanished and moved between two checkpoints: boxes in the scene, and a list."""

from collections.abc import Iterator
from typing import NamedTuple

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
from triquad_tools.viewer.page.legends import Legend, LineMeaning
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import text_html
from triquad_tools.viewer.page.refresher import Refresher
from triquad_tools.viewer.sources.history import Moment
from triquad_tools.viewer.sources.history_source import HistorySource

# Of Okabe and Ito's colours, which all can tell apart, those that stand out on mesh and background.
APPEARED, VANISHED, MOVED = "#56b4e9", "#d55e00", "#cc79a7"
_PERIOD_S = 1.0
_BEFORE = "the checkpoint before"
_NOTHING = "There is no checkpoint before this one: choose another to compare with."
_DRAWN, _LISTED = 50, 5  # at most, of each kind
_BESIDE_M = 0.1  # outlines lie so far outside of what they surround
_DASH_M = 0.8  # and a gap, together
_DASH_SHARE = 0.6
_LINE_PX = 3.0
_CORNERS = np.array(list(np.ndindex(2, 2, 2)))
_EDGES = [
    (first, second)
    for first in range(8)
    for second in range(first)
    if np.abs(_CORNERS[first] - _CORNERS[second]).sum() == 1
]


class Between(NamedTuple):
    """Two moments that are compared."""

    before: Moment
    after: Moment


class Change(NamedTuple):
    """One thing that changed, as it is drawn."""

    name: str  # in scene and list
    colour: str
    dashed: bool
    cluster: Cluster


class ChangesPanel:
    """Shows on request what changed up to the checkpoint that a page shows."""

    def __init__(self, source: HistorySource, page: Page) -> None:
        self._source = source
        self._page = page
        self._compared: Between | None = None
        self._handles: list[viser.SceneNodeHandle] = []
        self._folder = page.gui.add_folder("What changed")
        with self._folder:
            self._on = page.gui.add_checkbox("Show changes", False)
            self._since = page.gui.add_dropdown("Since", (_BEFORE,))
            self._text = page.gui.add_html("")
        self._refresher = Refresher("changes", self._refresh, _PERIOD_S, page.failed)
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
        for change in _drawn(found):
            self._outline(change)
        for number, move in enumerate(found.moved[:_DRAWN], start=1):
            way = np.array([[move.before.middle_m, move.after.middle_m]])
            self._add_lines(f"/changes/moved_{number}", way, MOVED)
        legend = _legend(between)
        self._page.legends.show("changes", legend)
        self._text.content = text_html(_heading(between)) + legend.html + text_html(_list(found))

    def _outline(self, change: Change) -> None:
        lines = _outline(change.cluster)
        name = f"/changes/{change.name}"
        self._add_lines(name, _dashes(lines) if change.dashed else lines, change.colour)
        top = change.cluster.middle_m + [0, 0, change.cluster.size_m[2] / 2 + 2 * _BESIDE_M]
        place = self._page.in_scene(top)
        self._handles.append(
            self._page.scene.add_label(f"{name}_name", change.name, position=place)
        )

    def _add_lines(self, name: str, lines: Doubles, colour: str) -> None:
        """Draw lines [L, 2, 3], metres, map frame."""
        self._handles.append(
            self._page.scene.add_line_segments(
                name,
                self._page.in_scene(lines),
                to_rgb(colour),
                thickness=_LINE_PX,
                thickness_units="screen",
            )
        )

    def _clear(self, text: str = "") -> None:
        for handle in self._handles:
            handle.remove()
        self._handles.clear()
        self._page.legends.hide("changes")
        content = text_html(text) if text else ""
        if self._text.content != content:
            self._text.content = content


def _drawn(found: ObjectChanges) -> Iterator[Change]:
    for number, cluster in enumerate(found.appeared[:_DRAWN], start=1):
        yield Change(f"A{number}", APPEARED, dashed=False, cluster=cluster)
    for number, cluster in enumerate(found.vanished[:_DRAWN], start=1):
        yield Change(f"V{number}", VANISHED, dashed=True, cluster=cluster)
    for number, move in enumerate(found.moved[:_DRAWN], start=1):
        yield Change(f"M{number} before", VANISHED, dashed=True, cluster=move.before)
        yield Change(f"M{number}", APPEARED, dashed=False, cluster=move.after)


def _outline(cluster: Cluster) -> Doubles:
    """The edges [12, 2, 3] of a box around a cluster, a little outside of it."""
    low, high = np.array(cluster.low_m) - _BESIDE_M, np.array(cluster.high_m) + _BESIDE_M
    corners = low + _CORNERS * (high - low)
    return np.asarray(corners[np.array(_EDGES)])


def _dashes(lines: Doubles) -> Doubles:
    """Lines [L, 2, 3] cut into dashes."""
    dashes = []
    for start, end in lines:
        count = max(3, round(np.linalg.norm(end - start) / _DASH_M))
        lows = start + np.arange(count)[:, None] / count * (end - start)
        dashes.append(np.stack([lows, lows + _DASH_SHARE / count * (end - start)], axis=1))
    return np.concatenate(dashes)


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


def _list(found: ObjectChanges) -> str:
    kinds = (
        ("appeared", [(f"A{n}", one) for n, one in enumerate(found.appeared, start=1)]),
        ("vanished", [(f"V{n}", one) for n, one in enumerate(found.vanished, start=1)]),
        ("moved", [(f"M{n}", one.after) for n, one in enumerate(found.moved, start=1)]),
    )
    lines = []
    for kind, clusters in kinds:
        lines.append(f"{len(clusters)} {kind}")
        lines += [f"  {name}: {_told(cluster)}" for name, cluster in clusters[:_LISTED]]
    lines.append(
        f"newly seen: {len(found.newly_seen)}, no longer known: {len(found.no_longer_known)} "
        "(not drawn: one of the two has never been there)"
    )
    small = found.small.appeared + found.small.vanished
    lines.append(f"{small} things of fewer than {LEAST_POINTS} voxels are left out")
    return "\n".join(lines)


def _told(cluster: Cluster) -> str:
    size = " × ".join(f"{side:.1f}" for side in cluster.size_m)
    place = ", ".join(f"{value:.1f}" for value in cluster.middle_m)
    return f"{cluster.points:,} voxels, {size} m, at {place}"
