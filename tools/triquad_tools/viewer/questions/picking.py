"""Surface that is seen in some direction, where the backs of surfaces are not drawn."""

import numpy as np
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status

from triquad_tools.viewer.page.page import Page

_REACH_M = 1000.0  # the longest ray that a map answers
_BEFORE_M = 250.0  # where the eye is far away, a ray starts this far before what it looks at
_BACKS = 24  # of surfaces that a ray passes
_BEFORE_FRONT_M = 0.2
_BEYOND_BACK_M = 0.4  # where a ray goes on: a surface seen from behind is that thick


def surface_along(page: Page, origin: Doubles, towards: Doubles) -> Doubles | None:
    """Return the first surface [3], metres, map frame, whose front a ray meets; else ``None``.

    Args:
        page: whose map is shown.
        origin: [3] metres, map frame.
        towards: [3] its direction, of any length but 0.

    Raises:
        TriquadError: the map does not answer.
    """
    direction, queries = towards / np.linalg.norm(towards), page.source.queries
    away_m = float(np.linalg.norm(page.focus.middle - page.eye))
    start = origin + max(away_m - _BEFORE_M, 0.0) * direction
    for _ in range(_BACKS):
        met = _first_surface(queries, start, direction)
        if met is None:
            return None
        # Before a front there is seen space; behind a surface distances are negative, or unknown.
        before = queries.query_distance(np.stack([met - _BEFORE_FRONT_M * direction, met]), 1.0)
        is_seen = before.status[0] != Status.UNKNOWN and before.distance_m[0] > 0
        if is_seen and float(before.gradient[1] @ direction) <= 0:
            return met
        start = met + _BEYOND_BACK_M * direction
    return None


def ground_in_view(page: Page) -> Doubles:
    """Return the ground [3], map frame, below what the camera is turned about; else that itself.

    Raises:
        TriquadError: the map does not answer.
    """
    middle, up = page.focus.middle, np.array([0.0, 0.0, 1.0])
    # From a metre above: what the camera is turned about may lie below the ground.
    below = _first_surface(page.source.queries, middle + up, -up)
    return middle if below is None else below


def _first_surface(queries: MapQueries, start: Doubles, direction: Doubles) -> Doubles | None:
    seen = queries.query_rays(start, direction[None], _REACH_M, through_unknown=True)
    if seen.status[0] != Status.SURFACE:
        return None
    return np.asarray(start + float(seen.range_m[0]) * direction, np.float64)
