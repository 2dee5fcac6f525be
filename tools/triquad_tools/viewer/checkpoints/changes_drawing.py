"""What changed between two checkpoints, in a scene: boxes, and lines along which it moved."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_format.records.arrays import Doubles

from triquad_tools.mapfiles.object_changes import Cluster, ObjectChanges
from triquad_tools.viewer.page.page import Page

# Of Okabe and Ito's colours, which all can tell apart, those that stand out on mesh and background.
APPEARED, VANISHED, MOVED = "#56b4e9", "#d55e00", "#cc79a7"
_MOST = 50  # of each kind are drawn
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


class Change(NamedTuple):
    """One thing that changed, as it is drawn."""

    name: str  # in scene and list
    colour: str
    dashed: bool
    cluster: Cluster


class ChangesDrawing:
    """What is drawn for changes, until it is erased."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._handles: list[viser.SceneNodeHandle] = []

    def draw(self, found: ObjectChanges) -> None:
        """Draw boxes around what changed, dashed where it was, and lines along which it moved."""
        for change in _changes(found):
            self._draw_box(change)
        for number, move in enumerate(found.moved[:_MOST], start=1):
            way = np.array([[move.before.middle_m, move.after.middle_m]])
            self._add_lines(f"/changes/moved_{number}", way, MOVED)

    def erase(self) -> None:
        """Take all of it away."""
        for handle in self._handles:
            handle.remove()
        self._handles.clear()

    def _draw_box(self, change: Change) -> None:
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


def _changes(found: ObjectChanges) -> Iterator[Change]:
    for number, cluster in enumerate(found.appeared[:_MOST], start=1):
        yield Change(f"A{number}", APPEARED, dashed=False, cluster=cluster)
    for number, cluster in enumerate(found.vanished[:_MOST], start=1):
        yield Change(f"V{number}", VANISHED, dashed=True, cluster=cluster)
    for number, move in enumerate(found.moved[:_MOST], start=1):
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
