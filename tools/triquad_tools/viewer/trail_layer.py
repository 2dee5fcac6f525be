"""The robot in a scene: the trail and the newest scan of each source, and what the server says."""

from collections.abc import Iterator

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_client import Client, ScanSource, ServerStatus, SourceReport
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.mesh.mesh_layer import MeshLayer
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import lines_html, problem_html
from triquad_tools.viewer.page.page import Page

_PERIOD_S = 0.5
_SCAN_POINTS = 4000
_COLOURS = ("#d55e00", "#cc79a7", "#000000", "#e69f00")
"""Colours of sources in turn, of Okabe and Ito, which all can distinguish; no mesh has them."""

_BEFORE = "#808080"
"""Colour of a trail as it was before its poses were corrected."""

_POINT_M, _LINE_PIXELS, _BEFORE_PIXELS = 0.08, 3.0, 1.5


class TrailLayer(Layer):
    """Draws trails and newest scans, and keeps them up to date."""

    def __init__(self, page: Page, client: Client, mesh: MeshLayer) -> None:
        super().__init__(page, "Robot and server", _PERIOD_S)
        self._client, self._mesh = client, mesh
        self._report: SourceReport | None = None
        self._before: dict[str, ScanSource] = {}  # by name: until its poses were corrected last
        self._shown: tuple[object, ...] = ()
        self._robot: Doubles | None = None  # where the robot was seen last, [3] metres, map frame
        with self.folder:
            self._trails = page.gui.add_checkbox("Trail", True)
            self._scans = page.gui.add_checkbox("Newest scan", True)
            self._follows = page.gui.add_checkbox("Follow the robot", False)
            self.add_text()
        self.start(self._trails, self._scans)

    def refresh(self) -> None:
        """Ask for what is new, and draw all where anything is."""
        report = self._client.sources(since=self._report, max_points=_SCAN_POINTS)
        self._keep_before(report)
        self._report, status = report, self._client.status()
        problems = map(problem_html, (status.store_error or "", *status.warnings))
        lines = (_line(name, source) for name, source in report.sources.items())
        self.page.entitle(*_state(status), *lines)
        before = lines_html((_BEFORE, "trail before the correction")) if self._before else ""
        self.tell(before + "".join(problems))
        self._follow(report)
        wanted = (report.server, report.revision, self._trails.value, self._scans.value)
        if wanted == self._shown:
            return
        marks: list[viser.SceneNodeHandle] = []
        for number, source in enumerate(report.sources.values()):
            marks += self._marks_of(source, _COLOURS[number % len(_COLOURS)])
        for source in self._before.values():
            marks += self._trail_of(source, _BEFORE, _BEFORE_PIXELS)
        self.draw(marks)
        self._shown = wanted

    def _keep_before(self, report: SourceReport) -> None:
        """Keep the trails that corrections have changed since the report before, as they were."""
        last = self._report
        known = last.sources if last is not None and last.server == report.server else {}
        for name, source in report.sources.items():
            was = known.get(name)
            if was is None or was.corrections > source.corrections:  # the server heard of it since
                self._before.pop(name, None)
            elif was.corrections < source.corrections:
                self._before[name] = was

    def _follow(self, report: SourceReport) -> None:
        """Move the camera as the robot did since: the source whose newest scan is the newest."""
        scans = [source.newest for source in report.sources.values() if source.newest is not None]
        if not scans:
            return
        before, self._robot = self._robot, max(scans, key=lambda scan: scan.stamp_ns).position_m
        if before is not None and self._follows.value and (before != self._robot).any():
            eye, middle = self.page.eye, self.page.focus.middle
            with self.page.client.atomic():
                self.page.client.camera.position = self.page.in_scene(eye + self._robot - before)
                self.page.client.camera.look_at = self.page.in_scene(middle + self._robot - before)

    def _marks_of(self, source: ScanSource, colour: str) -> list[viser.SceneNodeHandle]:
        marks = self._trail_of(source, colour, _LINE_PIXELS)
        if source.newest is not None and self._scans.value:
            points, light = self.page.in_scene(source.newest.points_m), np.array(to_rgb(colour))
            self._mesh.show_first(source.newest.points_m)
            cloud = self.page.scene.add_point_cloud(
                self.node("scan"), points, light, point_size=_POINT_M, precision="float32"
            )
            marks.append(cloud)
        return marks

    def _trail_of(
        self, source: ScanSource, colour: str, thickness: float
    ) -> list[viser.SceneNodeHandle]:
        lines = [line for line in source.lines() if len(line) > 1] if self._trails.value else []
        if not lines:
            return []
        pieces = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
        return [self.lines(pieces, colour, thickness, "screen")]


def _state(status: ServerStatus) -> Iterator[str]:
    dropped, lost = sum(status.scans_dropped.values()), sum(status.scans_lost.values())
    counts = {"waiting": status.scans_waiting, "refused": dropped, "lost": lost}
    unusual = "".join(f", {count:,} {what}" for what, count in counts.items() if count)
    # One line on a phone, where nothing is unusual. Of no scan, all is learnt.
    learnt = f"{status.learnt_percent} % learnt" if status.scans_taken else "nothing to learn yet"
    yield f"{status.scans_taken:,} scans{unusual}; {learnt}; epoch {status.epoch}"
    if status.correcting:
        yield f"correcting {status.correcting:,} scans: regions are made again"


def _line(name: str, source: ScanSource) -> str:
    if source.newest is None:
        return f"{name}: {source.scans:,} scans"
    x, y, z = source.newest.position_m
    return f"{name}: {source.scans:,} scans, now at {x:.1f}, {y:.1f}, {z:.1f} m"
