"""The length between two points, measured with a straight line."""

from dataclasses import dataclass

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import table_html

_COLOUR = "#c51b7d"  # no mesh has it
_BALL = 0.005  # radius, as a share of the distance of the eye; also how far the ground is below
_LINE_PIXELS = 3.0


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
        radii_m = _BALL * np.linalg.norm(ends - page.eye, axis=1)
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
