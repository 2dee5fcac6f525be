"""What is seen of a map in some direction, where the backs of surfaces are not drawn."""

import numpy as np
from numpy.typing import NDArray
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status

from triquad_tools.viewer.page.page import Page

_REACH_M = 1000.0  # the longest ray that a map answers
_BEFORE_M = 250.0  # where the eye is far away, a ray starts so far before what it looks at

_BACKS = 24  # of surfaces that a ray passes
_BEFORE_FRONT_M = 0.2
_BEYOND_BACK_M = 0.4  # where a ray goes on: a surface seen from behind is that thick
_A_LITTLE_ABOVE = np.array([0.0, 0.0, 1.0])  # metres: what it is turned about may lie below it
_DOWN = np.array([0.0, 0.0, -1.0])


def surface_along(page: Page, origin: NDArray[np.floating], towards: Doubles) -> Doubles | None:
    """The first surface [3], metres, map frame, whose front a ray meets; ``None``: it meets none.

    Args:
        page: whose map is looked at.
        origin: [3] metres, map frame.
        towards: [3] its direction, of any length but 0.

    Raises:
        TriquadError: the map does not answer.
    """
    direction = towards / np.linalg.norm(towards)
    camera = page.client.camera
    distance_m = float(np.linalg.norm(camera.look_at - camera.position))
    start = origin + max(distance_m - _BEFORE_M, 0.0) * direction
    for _ in range(_BACKS):
        met = _first_surface(page.source.queries, start, direction)
        if met is None or not _is_back(page.source.queries, met, direction):
            return met
        start = met + _BEYOND_BACK_M * direction
    return None


def ground_in_view(page: Page) -> Doubles:
    """The ground [3], map frame, below what the camera is turned about; else that itself.

    Raises:
        TriquadError: the map does not answer.
    """
    middle = page.in_map(page.client.camera.look_at)
    below = _first_surface(page.source.queries, middle + _A_LITTLE_ABOVE, _DOWN)
    return middle if below is None else below


def _first_surface(queries: MapQueries, start: Doubles, direction: Doubles) -> Doubles | None:
    seen = queries.query_rays(start, direction[None], _REACH_M, through_unknown=True)
    if seen.status[0] != Status.SURFACE:
        return None
    return np.asarray(start + float(seen.range_m[0]) * direction, np.float64)


def _is_back(queries: MapQueries, place: Doubles, direction: Doubles) -> bool:
    """Whether the surface at a place [3] is met from behind, along a unit vector [3].

    Before a front there is seen space; behind a surface distances are negative or nothing was seen.
    """
    before = place - _BEFORE_FRONT_M * direction
    answer = queries.query_distance(np.stack([before, place]), 1.0)
    seen = answer.status[0] != Status.UNKNOWN and answer.distance_m[0] > 0
    return not seen or float(answer.gradient[1] @ direction) > 0
