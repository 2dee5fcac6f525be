"""A page: one scene and one panel in one browser, and what its camera sees."""

import math
import threading
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.status import Status

from triquad_tools.viewer.page.legends import problem_html, text_html
from triquad_tools.viewer.sources import MapSource

_GRID_M = 100.0
_LEAST_SIDE_M, _MOST_SIDE_M = 2.0, 128.0

_REACH_M = 1000.0  # the longest ray that a map answers
_BEFORE_M = 250.0  # where the eye is far away, a ray starts this far before what it looks at
_BACKS = 24  # of surfaces that a ray passes
_BEFORE_FRONT_M = 0.2
_BEYOND_BACK_M = 0.4  # where a ray goes on: a surface seen from behind is that thick


class Focus(NamedTuple):
    """The middle of a view."""

    middle: Doubles  # [3] metres, map frame
    side_m: float  # about what is in view at that distance: a power of two, 2 to 128 m


class Page:
    """The page that its parts draw on; for several threads."""

    source: MapSource  # the map, which a part may replace: all others go on with the new one
    drawn: MapSource | None = None  # the map whose mesh is in the scene
    top_m = math.inf  # map frame: what lies above is not drawn, and no click meets it
    extent: Doubles | None = None
    """[2, 3] The corners of the mesh, metres, map frame; ``None``: it is empty."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self.client = client
        self.scene = client.scene
        self.gui = client.gui
        self._title = client.gui.add_html("")
        self._shown_problems = client.gui.add_html("")
        self._problems: dict[str, str] = {}  # by part of the page
        # [3] metres, map frame: the zero of the scene, near the first point that is drawn, since a
        # browser computes in single precision: half a metre in coordinates as large as UTM's
        self._origin: Doubles | None = None
        self._choosing = threading.Lock()

    def entitle(self, *lines: str) -> None:
        """Show which map it is and, in more lines, how it is doing; on a phone, this alone."""
        text = text_html("\n".join((self.source.title, *lines)))
        if self._title.content != text:
            self._title.content = text

    def in_scene(self, points: NDArray[np.floating]) -> Floats:
        """Return points [..., 3] of the map frame as the scene has them."""
        with self._choosing:
            if self._origin is None and points.size:
                first = np.asarray(points, np.float64).reshape(-1, 3)[0]
                self._origin = np.round(first / _GRID_M) * _GRID_M
        return np.asarray(points - (0.0 if self._origin is None else self._origin), np.float32)

    def in_map(self, points: NDArray[np.floating]) -> Doubles:
        """Return points [..., 3] of the scene in the map frame."""
        origin = np.zeros(3) if self._origin is None else self._origin
        return np.asarray(points, np.float64) + origin

    def failed(self, part: str, problem: str) -> None:
        """Show the problem of a part; with an empty text it has none any more."""
        self._problems[part] = problem
        different = dict.fromkeys(filter(None, list(self._problems.values())))
        self._shown_problems.content = problem_html("\n".join(different))

    @property
    def eye(self) -> Doubles:
        """The position of the camera [3], metres, map frame."""
        return self.in_map(self.client.camera.position)

    @property
    def focus(self) -> Focus:
        """The point that the camera is turned about."""
        camera = self.client.camera
        middle = self.in_map(camera.look_at)
        away_m = float(np.linalg.norm(middle - self.eye))
        seen_m = 2.0 * away_m * math.tan(0.5 * camera.fov) * max(camera.aspect, 1.0)
        side_m = 2.0 ** round(math.log2(max(seen_m, _LEAST_SIDE_M)))
        return Focus(middle, min(side_m, _MOST_SIDE_M))


def surface_along(page: Page, origin: Doubles, towards: Doubles) -> Doubles | None:
    """Return the first surface [3], metres, map frame, whose front a ray meets; else ``None``.

    What lies above the page's top does not count. A ray through a hole as small as a voxel meets
    what is around it.

    Args:
        page: whose map is shown.
        origin: [3] metres, map frame.
        towards: [3] its direction, of any length but 0.

    Raises:
        TriquadError: the map does not answer.
    """
    direction, queries = towards / np.linalg.norm(towards), page.source.queries
    away_m = float(np.linalg.norm(page.focus.middle - page.eye))
    top_m, start = page.top_m, origin + max(away_m - _BEFORE_M, 0.0) * direction
    if start[2] > top_m and direction[2] < 0:
        start = start + (top_m - start[2]) / direction[2] * direction
    cell_m = page.source.sizes.cell_m
    places = (start, *(start + side_m for side_m in sides(direction, (cell_m, 2 * cell_m))))
    found = (front(queries, at, direction) for at in places)
    return next((met for met in found if met is not None and met[2] <= top_m), None)


def sides(direction: Doubles, lengths: Sequence[float]) -> Iterator[Doubles]:
    """Yield eight vectors [3] around a unit vector, at right angles to it, for each length."""
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    across /= np.linalg.norm(across)
    for length in lengths:
        for turn in np.arange(8) * (math.pi / 4):
            up = np.cross(direction, across)
            yield length * (math.cos(turn) * across + math.sin(turn) * up)


def front(queries: MapQueries, start: Doubles, direction: Doubles) -> Doubles | None:
    """Return the first surface [3] whose front a ray from ``start`` [3] meets; else ``None``."""
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
