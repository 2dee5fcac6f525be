"""A path in a scene: its points, a tube in the colours of its clearance, and what stops a robot."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_format.records.arrays import Bytes, Doubles

from triquad_tools.plots.slice_plan import BEHIND
from triquad_tools.viewer.asking.distance_scale import distance_colours
from triquad_tools.viewer.asking.path_check import PathAnswer
from triquad_tools.viewer.asking.tube import Tube, add_tube
from triquad_tools.viewer.page.page import Page

_LEAST_WIDTH = 0.002  # radius of what is drawn, as a share of the distance of the eye


class PathDrawing:
    """What is drawn for a path, until it is drawn anew."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._marks: list[viser.SceneNodeHandle] = []

    def draw(self, points: Sequence[Doubles], answer: PathAnswer | None) -> None:
        """Draw a path through points [3], map frame, and what a map says about it, if it did."""
        with self._page.client.atomic():
            for mark in self._marks:
                mark.remove()
            self._marks.clear()
            for number, point in enumerate(points, start=1):
                self._label(f"points/{number}", f"{number}", point, anchor="center-right")
            if answer is not None:
                self._draw_answer(answer)

    def _draw_answer(self, answer: PathAnswer) -> None:
        eye = self._page.in_map(self._page.client.camera.position)
        least_m = _LEAST_WIDTH * float(np.linalg.norm(answer.points[-1] - eye))
        radii_m = np.full(len(answer.cuts), max(answer.radius_m, least_m))
        tube = Tube(answer.cuts, radii_m, piece_colours(answer) / 255.0)
        self._marks.append(add_tube(self._page, "/path/tube", tube))
        whole = answer.whole
        if whole.meets_unknown:
            text = f"unknown from {whole.unknown_contact_m:.2f} m"
            place = answer.at(whole.unknown_contact_m)
            self._label("unknown", text, place, anchor="top-left")
        if whole.blocked:
            text = f"✖ blocked at {whole.contact_m:.2f} m"
            self._label("blocked", text, answer.at(whole.contact_m), anchor="bottom-left")

    def _label(
        self,
        name: str,
        text: str,
        place: Doubles,
        *,
        anchor: Literal["center-right", "bottom-left", "top-left"],
    ) -> None:
        """Write a text beside a place [3]; ``anchor`` is the part of the text that lies there.

        Three of them at one place, as where a path is blocked at its first point, can all be read.
        """
        label = self._page.scene.add_label(
            f"/path/{name}", text, position=self._page.in_scene(place), anchor=anchor
        )
        self._marks.append(label)


def piece_colours(answer: PathAnswer) -> Bytes:
    """Colours [P, 3] of the pieces: of their clearance, or of what stops the robot there."""
    pieces = answer.pieces
    colours = distance_colours(pieces.clearance_m, ~pieces.meets_unknown, answer.reach_m)
    colours[pieces.blocked] = np.round(255.0 * np.array(to_rgb(BEHIND)))
    return colours
