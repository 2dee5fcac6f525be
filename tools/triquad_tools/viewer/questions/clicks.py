"""Clicks into a scene: they query the map at a point or along a path, or measure a length."""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_client import Distances, Polyline, Status
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_format.wire.limits import MAX_DISTANCE_M

from triquad_tools.plots.colours import BEHIND, UNKNOWN
from triquad_tools.viewer.page.layer import Answer, Layer, Question
from triquad_tools.viewer.page.legends import lines_html, table_html, text_html
from triquad_tools.viewer.page.page import Page, surface_along

_POINT_REACH_M = 10.0  # how far around a point surfaces are searched for

_BALL, _ARROW = 0.006, 0.08  # radius and length, as shares of the distance of the eye
_COLOUR = "#c51b7d"  # no mesh has it

_END = 0.005  # radius, as a share of the distance of the eye; also how far the ground is below
_LINE_PIXELS = 3.0

_LEAST_REACH_M, _REACH_RADII = 1.0, 3.0  # how far around surfaces are searched for
_LEAST_WIDTH = 0.004  # of what is drawn, as a share of the distance of the eye
_FREE = "#0072b2"
_LEGEND = lines_html(
    (_FREE, "the robot passes"),
    (UNKNOWN, "it is in unknown space, or was before"),
    (BEHIND, "it touches a surface, or did before"),
)
_ASKS, _MEASURES, _LAYS = "asks the map", "measures a length", "adds to the path"
_NOTHING = "does nothing"
_RAISED_M, _RADIUS_M = 0.5, 0.3
_LEAST_LEG_M = 0.01  # a second click at the same place adds nothing
_HINT = "Click at a surface."
_OTHER_END = "Click at the other end."
_SKY = "No surface there: sky, or nothing was seen in that direction."


@dataclass(frozen=True)
class Point:
    """A point above a surface."""

    surface: tuple[float, ...]  # [3] metres, map frame
    raised_m: float

    @property
    def place(self) -> Doubles:
        """The point [3] itself."""
        return np.array(self.surface) + [0.0, 0.0, self.raised_m]

    def html(self, answer: Distances) -> str:
        """Return what the map answers about it."""
        x, y, z = self.place
        status, distance_m = Status(int(answer.status[0])), float(answer.distance_m[0])
        distance, gradient = f"no surface within {_POINT_REACH_M:g} m", "none"
        if answer.found[0]:
            distance = f"{distance_m:.3f} m" + (", behind a surface" if distance_m < 0 else "")
            gradient = ", ".join(f"{part:.2f}" for part in answer.gradient[0])
        unseen = ": not seen, so the distance is to what was" if status is Status.UNKNOWN else ""
        rows = [
            ("position", f"{x:.3f}, {y:.3f}, {z:.3f} m"),
            ("raised by", f"{self.raised_m:.2f} m"),
            ("distance", distance),
            ("gradient", gradient),
            ("status", f"{status.name}{unseen}"),
            ("confidence", f"{float(answer.confidence[0]):.2f}"),
            ("epoch", f"{answer.epoch}"),
        ]
        return table_html(rows)

    def marks(self, layer: Layer, answer: Distances) -> list[viser.SceneNodeHandle]:
        """Draw a ball, a stem up from the surface, and the gradient as an arrow."""
        page, place = layer.page, self.place
        eye_m = float(np.linalg.norm(place - page.eye))
        light, at, radius_m = to_rgb(_COLOUR), page.in_scene(place), _BALL * eye_m
        stem, thick_m = np.array([[self.surface, place]]), 0.4 * radius_m
        marks: list[viser.SceneNodeHandle] = [
            page.scene.add_icosphere(layer.node("ball"), radius_m, light, position=at),
            layer.lines(stem, _COLOUR, thick_m),
        ]
        if answer.found[0]:
            length_m = _ARROW * eye_m
            ends = page.in_scene(np.array([[place, place + length_m * answer.gradient[0]]]))
            arrow = page.scene.add_arrows(
                layer.node("gradient"), ends, np.array(light), shaft_radius=thick_m,
                head_radius=radius_m, head_length=0.3 * length_m,
            )  # fmt: skip
            marks.append(arrow)
        return marks


class Path:
    """A ball that moves from point to point, and what the map answers about it."""

    def __init__(self, queries: MapQueries, points: Doubles, radius_m: float) -> None:
        """Ask about points [N, 3], at least two, metres, map frame."""
        self._points = points
        self._radius_m = radius_m
        self._reach_m = min(max(_LEAST_REACH_M, _REACH_RADII * radius_m), MAX_DISTANCE_M)
        self.answer: Polyline = queries.query_polyline(points, radius_m, self._reach_m)

    def html(self) -> str:
        """Return the answer."""
        answer = self.answer
        rows = [("path", f"{len(self._points)} points, {answer.length_m:.2f} m")]
        if answer.blocked:
            rows.append(("blocked", f"⚠ at {answer.contact_m:.2f} m"))
        if answer.meets_unknown:
            rows.append(("unknown", f"⚠ from {answer.unknown_contact_m:.2f} m"))
        if answer.free():
            rows.append(("free", f"all along, with radius {self._radius_m:g} m"))
        least = f"{answer.clearance_m:.2f} m, at {answer.clearance_at_m:.2f} m"
        if answer.clearance_m >= self._reach_m:
            least = f"{self._reach_m:g} m or more"
        return _LEGEND + table_html([*rows, ("least clearance", least)])

    def legs(self) -> list[tuple[str, Doubles]]:
        """Return its stretches, each with a colour and the points [N, 3] along it."""
        answer, places = self.answer, self._points
        steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
        ends_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        contact_m = min(answer.contact_m if answer.blocked else np.inf, ends_m[-1])
        unknown_m = min(answer.unknown_contact_m if answer.meets_unknown else np.inf, contact_m)
        cuts_m = [0.0, unknown_m, contact_m, ends_m[-1]]
        legs = []
        for colour, (start_m, end_m) in zip(
            (_FREE, UNKNOWN, BEHIND), pairwise(cuts_m), strict=True
        ):
            if end_m > start_m:
                inner_m = ends_m[(ends_m > start_m) & (ends_m < end_m)]
                along_m = np.concatenate([[start_m], inner_m, [end_m]])
                leg = np.stack([np.interp(along_m, ends_m, axis) for axis in places.T], axis=1)
                legs.append((colour, leg))
        return legs

    def marks(self, layer: Layer) -> list[viser.SceneNodeHandle]:
        """Draw the numbers of its points, and the stretches as wide as the robot."""
        page = layer.page
        marks: list[viser.SceneNodeHandle] = [
            page.scene.add_label(layer.node("number"), f"{number}", position=page.in_scene(point))
            for number, point in enumerate(self._points, start=1)
        ]
        for colour, leg in self.legs():
            least_m = _LEAST_WIDTH * float(np.linalg.norm(leg[-1] - page.eye))
            pieces = np.stack([leg[:-1], leg[1:]], axis=1)
            marks.append(layer.lines(pieces, colour, max(2.0 * self._radius_m, least_m)))
        return marks


@dataclass(frozen=True)
class Measure:
    """A straight line from one point to another."""

    start: Doubles  # [3] metres, map frame
    end: Doubles  # [3]

    def html(self) -> str:
        """Return its length, and how much of it is level and upright."""
        across = self.end - self.start
        rows = [
            ("length", f"{np.linalg.norm(across):.3f} m"),
            ("level", f"{np.linalg.norm(across[:2]):.3f} m"),
            ("upright", f"{across[2]:+.3f} m"),
        ]
        return table_html(rows)

    def marks(self, layer: Layer) -> list[viser.SceneNodeHandle]:
        """Draw it a little above the ground, with a ball at each end and its length."""
        scene, page = layer.page.scene, layer.page
        ends = np.stack([self.start, self.end])
        radii_m = _END * np.linalg.norm(ends - page.eye, axis=1)
        raised = ends + radii_m[:, None] * [0.0, 0.0, 1.0]
        length = f"{np.linalg.norm(self.end - self.start):.2f} m"
        return [
            *(
                scene.add_icosphere(
                    layer.node("end"), float(radius_m), to_rgb(_COLOUR), position=page.in_scene(end)
                )
                for radius_m, end in zip(radii_m, raised, strict=True)
            ),
            layer.lines(raised[None], _COLOUR, _LINE_PIXELS, "screen"),
            scene.add_label(layer.node("length"), length, position=page.in_scene(raised.mean(0))),
        ]


@dataclass(frozen=True)
class Clicked:
    """The points that were clicked at, one at least, and a robot that moves along them."""

    points: tuple[Point, ...]
    radius_m: float
    sky: bool  # whether the newest click met no surface
    measured: bool  # from one to the next, without a robot


class Clicks(Question[Clicked]):
    """Shows what the map answers at the newest point, and about the path through all."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Clicks")
        self._events: deque[viser.SceneClickEvent] = deque()
        self._points: tuple[Point, ...] = ()
        self._sky = self._measured = False
        self.hint = _HINT
        gui = page.gui
        with self.folder:
            self._use = gui.add_dropdown("A click", (_ASKS, _MEASURES, _LAYS, _NOTHING))
            self._raised = gui.add_number("Raised by (m)", _RAISED_M, min=0.0, max=100.0, step=0.05)
            self._radius = gui.add_number("Radius (m)", _RADIUS_M, min=0.0, max=50.0, step=0.05)
            self._undo = gui.add_button("Undo last point")
            self._clear = gui.add_button("Clear path")
            self._save = gui.add_button("Save path (CSV)")
            self.add_text(text_html(_HINT))
        self._undo.on_click(lambda _: self._keep(self._points[:-1]))
        self._clear.on_click(lambda _: self._keep(()))
        self._save.on_click(lambda _: self._send())
        page.scene.on_click()(self._clicked)
        self.start(self._use, self._radius)

    def close(self) -> None:
        """Listen and draw no more; remove what was drawn and the folder."""
        self.page.scene.remove_click_callback(self._clicked)
        super().close()

    def wanted(self) -> Clicked | None:
        """Find what was clicked at, and return it with all before, if there is anything."""
        is_path = len(self._points) > 1 and not self._measured
        for control in (self._radius, self._undo, self._clear):
            control.visible = self._use.value == _LAYS or is_path
        self._save.visible = is_path
        while self._events:
            self._find(self._events.popleft())
        self.hint = _SKY if self._sky else _HINT
        radius_m = float(self._radius.value)
        clicked = Clicked(self._points, radius_m, self._sky, self._measured)
        return clicked if self._points else None

    def ask(self, wanted: Clicked) -> Answer:
        """Ask at the newest point, and about the path if there are several."""
        queries, point = self.page.source.queries, wanted.points[-1]
        told = text_html(_SKY if wanted.sky else _OTHER_END if wanted.measured else "")
        found = queries.query_distance(point.place[None], _POINT_REACH_M)
        if wanted.measured and len(wanted.points) > 1:
            measure = Measure(wanted.points[0].place, point.place)
            return Answer(measure.html(), found.epoch, measure.marks(self))
        if len(wanted.points) == 1:
            html, marks = told + point.html(found), point.marks(self, found)
            return Answer(html, found.epoch, marks)
        places = np.array([each.place for each in wanted.points])
        path = Path(queries, places, wanted.radius_m)
        html = told + path.html() + point.html(found)
        return Answer(html, found.epoch, path.marks(self) + point.marks(self, found))

    def _send(self) -> None:
        """Send the points of the path to the browser, as they were clicked at and raised."""
        rows = (f"{x:.4f},{y:.4f},{z:.4f}" for x, y, z in (each.place for each in self._points))
        text = "\n".join(["x_m,y_m,z_m", *rows, ""])
        self.page.client.send_file_download(
            "triquad-path.csv", text.encode(), save_immediately=True
        )

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self._use.value != _NOTHING:
            self._events.append(event)
            self.wake()

    def _keep(self, points: tuple[Point, ...]) -> None:
        self._points, self._sky = points, False
        self.wake()

    def _find(self, event: viser.SceneClickEvent) -> None:
        origin = self.page.in_map(np.array(event.ray_origin))
        surface = surface_along(self.page, origin, np.array(event.ray_direction))
        self._sky = surface is None
        use, was_measured = self._use.value, self._measured
        self._measured = use == _MEASURES
        goes_on = use == _LAYS and not was_measured or self._measured and len(self._points) == 1
        before = self._points if goes_on else ()
        if surface is None:
            self._points = before
            return
        raised_m = 0.0 if self._measured else float(self._raised.value)
        point = Point(tuple(surface.tolist()), raised_m)
        if not before or np.linalg.norm(point.place - before[-1].place) > _LEAST_LEG_M:
            before += (point,)
        self._points = before
