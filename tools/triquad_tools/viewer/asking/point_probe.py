"""What the map says at a point, in the panel and in the scene."""

from dataclasses import dataclass

import numpy as np
import viser
from triquad_client import Distances, Status
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.asking.questions import newest_epoch
from triquad_tools.viewer.asking.tube import add_tube, arrow
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import table_html, text_html

_MAX_DISTANCE_M = 10.0
_SKY = text_html("No surface there: sky, or nothing was seen in that direction.")
_HOW = text_html("Click at a surface.")
_BALL, _ARROW = 0.006, 0.08  # radius and length, as shares of the distance of the eye
_COLOUR = (230, 159, 0)


@dataclass(frozen=True)
class AskedPoint:
    """Where the map is asked."""

    surface: Doubles  # [3] metres, map frame: what was clicked at
    raised_m: float
    eye_m: float  # distance of the eye when it was

    @property
    def place(self) -> Doubles:
        """The point [3] itself."""
        return np.asarray(self.surface + [0.0, 0.0, self.raised_m], np.float64)


class PointProbe:
    """A point that is asked about, until it is put elsewhere."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._text = page.gui.add_html(_HOW)
        self._point: AskedPoint | None = None
        self._epoch = 0
        self._marks: list[viser.SceneNodeHandle] = []

    @property
    def unanswered(self) -> bool:
        """Whether there is a point that the map was not asked about yet."""
        return self._point is not None and self._epoch == 0

    def put(self, surface: Doubles | None, raised_m: float) -> None:
        """Ask so far above a point [3] of a surface, map frame; ``None``: sky was clicked at.

        Raises:
            TriquadError: the map does not answer.
        """
        self.clear()
        if surface is None:
            self._text.content = _SKY
            return
        eye = self._page.in_map(self._page.client.camera.position)
        self._point = AskedPoint(surface, raised_m, float(np.linalg.norm(surface - eye)))
        self._ask(self._point)

    def refresh(self) -> None:
        """Ask again where the map has gone on.

        Raises:
            TriquadError: the map does not answer.
        """
        if self._point is not None and newest_epoch(self._page.source.queries) != self._epoch:
            self._ask(self._point)

    def clear(self) -> None:
        """Ask about nothing."""
        self._erase()
        self._point = None
        self._epoch = 0
        self._text.content = _HOW

    def _ask(self, point: AskedPoint) -> None:
        answer = self._page.source.queries.query_distance(point.place[None], _MAX_DISTANCE_M)
        self._epoch = answer.epoch
        self._text.content = point_html(point, answer)
        with self._page.client.atomic():
            self._erase()
            self._draw(point, answer)

    def _draw(self, point: AskedPoint, answer: Distances) -> None:
        scene, in_scene = self._page.scene, self._page.in_scene
        place, radius_m = in_scene(point.place), _BALL * point.eye_m
        stem = np.stack([in_scene(point.surface), place])[None]
        self._marks = [
            scene.add_icosphere("/point/ball", radius_m, _COLOUR, position=place),
            scene.add_line_segments(
                "/point/stem", stem, _COLOUR, thickness=2.0, thickness_units="screen"
            ),
        ]
        if answer.found[0]:
            along = _ARROW * point.eye_m * answer.gradient[0].astype(np.float64)
            tube = arrow(point.place, along, 0.4 * radius_m, np.array(_COLOUR) / 255.0)
            self._marks.append(add_tube(self._page, "/point/gradient", tube))

    def _erase(self) -> None:
        for mark in self._marks:
            mark.remove()
        self._marks = []


def point_html(point: AskedPoint, answer: Distances) -> str:
    """What the map answers about one point."""
    x, y, z = point.place
    status = Status(int(answer.status[0]))
    distance_m = float(answer.distance_m[0])
    if not answer.found[0]:
        distance = f"no surface within {_MAX_DISTANCE_M:g} m"
    else:
        distance = f"{distance_m:.3f} m" + (", behind a surface" if distance_m < 0 else "")
    gradient = (
        ", ".join(f"{part:.2f}" for part in answer.gradient[0]) if answer.found[0] else "none"
    )
    unseen = ": not seen, so the distance is to what was" if status is Status.UNKNOWN else ""
    rows = [
        ("position", f"{x:.3f}, {y:.3f}, {z:.3f} m"),
        ("raised by", f"{point.raised_m:.2f} m"),
        ("distance", distance),
        ("gradient", gradient),
        ("status", f"{status.name}{unseen}"),
        ("confidence", f"{float(answer.confidence[0]):.2f}"),
        ("epoch", f"{answer.epoch}"),
    ]
    return table_html(rows)
