"""A point at which a map is queried: its answer in the panel and in the scene."""

from dataclasses import dataclass

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_client import Distances, Status
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import table_html

MAX_DISTANCE_M = 10.0
"""How far around a point surfaces are searched for."""

_BALL, _ARROW = 0.006, 0.08  # radius and length, as shares of the distance of the eye
_COLOUR = "#c51b7d"  # no mesh has it


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
        distance, gradient = f"no surface within {MAX_DISTANCE_M:g} m", "none"
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
