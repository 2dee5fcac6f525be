"""A query at a point, shown in the panel and in the scene."""

from typing import NamedTuple

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_client import Distances, Status
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import table_html

_MAX_DISTANCE_M = 10.0
_BALL, _ARROW = 0.006, 0.08  # radius and length, as shares of the distance of the eye
_COLOUR = to_rgb("#c51b7d")  # no mesh has it


class AskedPoint(NamedTuple):
    """A point at which the map is queried."""

    surface: tuple[float, ...]  # [3] metres, map frame: what was clicked at
    raised_m: float

    @property
    def place(self) -> Doubles:
        """The point [3] itself."""
        return np.array(self.surface) + [0.0, 0.0, self.raised_m]


def ask_point(queries: MapQueries, point: AskedPoint) -> Distances:
    """Ask for the distance.

    Raises:
        TriquadError: the map does not answer.
    """
    return queries.query_distance(point.place[None], _MAX_DISTANCE_M)


def point_html(point: AskedPoint, answer: Distances) -> str:
    """Return what the map answers about a point, as HTML."""
    x, y, z = point.place
    status, distance_m = Status(int(answer.status[0])), float(answer.distance_m[0])
    distance, gradient = f"no surface within {_MAX_DISTANCE_M:g} m", "none"
    if answer.found[0]:
        distance = f"{distance_m:.3f} m" + (", behind a surface" if distance_m < 0 else "")
        gradient = ", ".join(f"{part:.2f}" for part in answer.gradient[0])
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


def point_marks(layer: Layer, point: AskedPoint, answer: Distances) -> list[viser.SceneNodeHandle]:
    """Draw a ball at a point, a stem up from the surface, and the gradient as an arrow."""
    page, place = layer.page, point.place
    eye_m = float(np.linalg.norm(place - page.eye))
    colour, at, radius_m = np.array(_COLOUR), page.in_scene(place), _BALL * eye_m
    stem = page.in_scene(np.array([[point.surface, place]]))
    marks: list[viser.SceneNodeHandle] = [
        page.scene.add_icosphere(layer.node("ball"), radius_m, _COLOUR, position=at),
        page.scene.add_line_segments(layer.node("stem"), stem, colour, thickness=0.4 * radius_m),
    ]
    if answer.found[0]:
        length_m = _ARROW * eye_m
        ends = page.in_scene(np.array([[place, place + length_m * answer.gradient[0]]]))
        arrow = page.scene.add_arrows(
            layer.node("gradient"), ends, colour, shaft_radius=0.4 * radius_m,
            head_radius=radius_m, head_length=0.3 * length_m,
        )  # fmt: skip
        marks.append(arrow)
    return marks
