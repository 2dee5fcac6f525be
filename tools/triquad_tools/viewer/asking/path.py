"""Queries of whether a robot can move along a path, and its clearance."""

from collections.abc import Sequence

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_client import Polyline
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_format.wire.limits import MAX_DISTANCE_M

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import BEHIND
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import Legend, LineMeaning, table_html

_LEAST_REACH_M, _REACH_RADII = 1.0, 3.0  # how far around surfaces are searched for
_LEAST_WIDTH = 0.004  # of what is drawn, as a share of the distance of the eye
_FREE = "#0072b2"
LEGEND = Legend(
    lines=(
        LineMeaning(_FREE, "the robot passes"),
        LineMeaning(UNKNOWN, "it is in unknown space, or was before"),
        LineMeaning(BEHIND, "it touches a surface, or did before"),
    )
)


def reach_of(radius_m: float) -> float:
    """Return up to which clearance is reported for a robot of some radius, metres."""
    return min(max(_LEAST_REACH_M, _REACH_RADII * radius_m), MAX_DISTANCE_M)


def ask_path(queries: MapQueries, points: Sequence[Doubles], radius_m: float) -> Polyline:
    """Ask about a ball that moves along points [3], at least two, metres, map frame.

    Raises:
        TriquadError: the map does not answer, or not about so long a path.
    """
    return queries.query_polyline(np.array(points), radius_m, reach_of(radius_m))


def path_html(points: int, radius_m: float, answer: Polyline) -> str:
    """Return what the map answers about a path of N points, as HTML."""
    rows = [("path", f"{points} points, {answer.length_m:.2f} m")]
    if answer.blocked:
        rows.append(("blocked", f"⚠ at {answer.contact_m:.2f} m"))
    if answer.meets_unknown:
        rows.append(("unknown", f"⚠ from {answer.unknown_contact_m:.2f} m"))
    if answer.free():
        rows.append(("free", f"all along, with radius {radius_m:g} m"))
    least = f"{answer.clearance_m:.2f} m, at {answer.clearance_at_m:.2f} m"
    if answer.clearance_m >= reach_of(radius_m):
        least = f"{reach_of(radius_m):g} m or more"
    rows += [("least clearance", least), ("epoch", f"{answer.epoch}")]
    return table_html(rows)


def path_legs(points: Sequence[Doubles], answer: Polyline) -> list[tuple[str, Doubles]]:
    """Return stretches of a path, each with a colour and the points [N, 3] along it."""
    places = np.array(points)
    ends_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    unknown_m = answer.unknown_contact_m if answer.meets_unknown else np.inf
    contact_m = answer.contact_m if answer.blocked else np.inf
    cuts_m = [0.0, min(unknown_m, contact_m, ends_m[-1]), min(contact_m, ends_m[-1]), ends_m[-1]]
    legs = []
    for colour, start_m, end_m in zip((_FREE, UNKNOWN, BEHIND), cuts_m, cuts_m[1:], strict=False):
        if end_m > start_m:
            inner_m = ends_m[(ends_m > start_m) & (ends_m < end_m)]
            along_m = np.concatenate([[start_m], inner_m, [end_m]])
            leg = np.stack([np.interp(along_m, ends_m, axis) for axis in places.T], axis=1)
            legs.append((colour, leg))
    return legs


def path_marks(
    layer: Layer, points: Sequence[Doubles], radius_m: float, answer: Polyline | None
) -> list[viser.SceneNodeHandle]:
    """Draw the numbers of points [3], map frame, and the path, as wide as the robot."""
    page = layer.page
    marks: list[viser.SceneNodeHandle] = [
        page.scene.add_label(layer.node("number"), f"{number}", position=page.in_scene(point))
        for number, point in enumerate(points, start=1)
    ]
    for colour, leg in [] if answer is None else path_legs(points, answer):
        least_m = _LEAST_WIDTH * float(np.linalg.norm(leg[-1] - page.eye))
        pieces = page.in_scene(np.stack([leg[:-1], leg[1:]], axis=1))
        wide_m = max(2.0 * radius_m, least_m)
        name, light = layer.node("leg"), np.array(to_rgb(colour))
        marks.append(page.scene.add_line_segments(name, pieces, light, thickness=wide_m))
    return marks
