"""A path of a robot: what the map answers about it, in the panel and in the scene."""

from itertools import pairwise

import numpy as np
import viser
from triquad_client import Polyline
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_format.wire.limits import MAX_DISTANCE_M

from triquad_tools.plots.colours import BEHIND, UNKNOWN
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import lines_html, table_html

_LEAST_REACH_M, _REACH_RADII = 1.0, 3.0  # how far around surfaces are searched for
_LEAST_WIDTH = 0.004  # of what is drawn, as a share of the distance of the eye
_FREE = "#0072b2"
_LEGEND = lines_html(
    (_FREE, "the robot passes"),
    (UNKNOWN, "it is in unknown space, or was before"),
    (BEHIND, "it touches a surface, or did before"),
)


class Path:
    """A ball that moves from point to point, and what the map answers about it."""

    def __init__(self, queries: MapQueries, points: Doubles, radius_m: float) -> None:
        """Ask about points [N, 3], at least two, metres, map frame.

        Raises:
            TriquadError: the map does not answer, or not about so long a path.
        """
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
