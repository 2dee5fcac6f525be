"""The robot in a scene: where each source of scans has been, and its newest scan."""

import numpy as np
import viser
from triquad_client.calls.sources import ScanSource, SourceReport

from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import text_html
from triquad_tools.viewer.page.refresher import Refresher
from triquad_tools.viewer.sources.live_source import LiveSource

_PERIOD_S = 0.5
_SCAN_POINTS = 4000
_COLOURS = ((213, 94, 0), (204, 121, 167), (0, 0, 0), (230, 159, 0))
"""Of sources in turn: of those of Okabe and Ito, which everybody tells apart, what no mesh has."""

_POINT_M = 0.08
_LINE_PIXELS = 3.0


class TrailLayer:
    """Draws trails and newest scans, and keeps them up to date."""

    def __init__(self, source: LiveSource, page: Page) -> None:
        self._page = page
        self._client = source.client
        self._report: SourceReport | None = None
        self._number = 0
        self._drawn: dict[str, list[viser.SceneNodeHandle]] = {}
        self._folder = page.gui.add_folder("Robot")
        with self._folder:
            self._trails = page.gui.add_checkbox("Trail", True)
            self._scans = page.gui.add_checkbox("Newest scan", True)
            self._list = page.gui.add_html(text_html("No scan has come yet."))
        self._refresher = Refresher("trail", self._refresh, period_s=_PERIOD_S, failed=page.failed)
        for control in (self._trails, self._scans):
            control.on_update(lambda _: self._redraw())

    def close(self) -> None:
        """Draw no more."""
        self._refresher.close()
        for name in list(self._drawn):
            self._remove(name)
        self._folder.remove()

    def _redraw(self) -> None:
        self._report = None  # all sources are told anew, and drawn
        self._refresher.wake()

    def _refresh(self) -> None:
        before = self._report
        report = self._client.sources(since=before, max_points=_SCAN_POINTS)
        if before and (report.server, report.revision) == (before.server, before.revision):
            return
        self._report = report
        for name in self._drawn.keys() - report.sources.keys():
            self._remove(name)
        for number, source in enumerate(report.sources.values()):
            self._draw(source, _COLOURS[number % len(_COLOURS)])
        if report.sources:
            self._list.content = text_html("\n".join(map(_line, report.sources.values())))

    def _draw(self, source: ScanSource, colour: tuple[int, int, int]) -> None:
        self._number += 1
        root = f"/robot/{self._number}"
        handles: list[viser.SceneNodeHandle] = []
        lines = [line for line in source.lines() if len(line) > 1] if self._trails.value else []
        if lines:
            pieces = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
            handles.append(
                self._page.scene.add_line_segments(
                    f"{root}/trail",
                    self._page.in_scene(pieces),
                    colors=colour,
                    thickness=_LINE_PIXELS,
                    thickness_units="screen",
                )
            )
        if source.newest is not None and self._scans.value:
            at = self._page.in_scene(source.newest.points)
            handles.append(
                self._page.scene.add_point_cloud(
                    f"{root}/scan", at, colour, point_size=_POINT_M, precision="float32"
                )
            )
        self._remove(source.name)  # what is new is there already: nothing flickers
        self._drawn[source.name] = handles

    def _remove(self, name: str) -> None:
        for handle in self._drawn.pop(name, []):
            handle.remove()


def _line(source: ScanSource) -> str:
    """What the panel says of a source."""
    if source.newest is None:
        return f"{source.name}: {source.scans:,} scans"
    x, y, z = source.newest.position_m
    return f"{source.name}: {source.scans:,} scans, now at {x:.1f}, {y:.1f}, {z:.1f} m"
