"""Questions about ways through the map, and about where a scan was taken.

:mod:`triquad_map.questions.answers` is the other side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.errors import InvalidInputError
from triquad_format.wire.limits import (
    MAX_RANGE_M,
    MAX_SEARCHES,
    RAY_M_PER_SEARCH,
    SEGMENT_M_PER_SEARCH,
)
from triquad_format.wire.query_messages import (
    AlignRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
)
from triquad_map.questions.align import FINE_POINTS, Alignment, thinned
from triquad_map.questions.bodies import Polyline, Segments, along_polyline
from triquad_map.questions.ground import Ground
from triquad_map.questions.rays import RayRanges

from triquad_client import checks
from triquad_client.calls.questions_in_parts import Asking, Part
from triquad_client.pose import PoseLike, rigid_pose

_MOST_WAYS = 1_000
"""Segments, rays or columns down to the ground of one request, however short they are."""


class WayQueries(Asking):
    """Questions about ways, and about where a scan was taken; see :class:`MapQueries`."""

    def query_segments(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        radius_m: float = 0.0,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Segments:
        """Return what a ball meets that moves straight from each of ``starts`` to ``ends`` [N, 3].

        Args:
            starts: metres, map frame.
            ends: as many.
            radius_m: of the ball.
            max_distance_m: clearance is searched for up to here, at most 100 m.
            at_epoch: see :class:`MapQueries`.
        """
        first, last = checks.query_points(starts), checks.query_points(ends)
        if len(first) != len(last):
            raise InvalidInputError(f"{len(first)} starts and {len(last)} ends: give as many")
        ball_m = checks.within("radius_m", radius_m, least=0.0)
        reach_m = checks.within("max_distance_m", max_distance_m)

        def request(part: Part) -> SegmentsRequest:
            begin, end = part.offsets(first), part.offsets(last)
            return SegmentsRequest(part.origin, begin, end, ball_m, reach_m, part.epoch)

        longest_m = float(np.linalg.norm(last - first, axis=1).max(initial=0.0))
        most = _ways_at_once(longest_m / SEGMENT_M_PER_SEARCH)
        answered = self._in_parts(request, first, most=most, at_epoch=at_epoch)
        return Segments(**answered.joined(flags=["blocked", "meets_unknown"]))

    def query_polyline(
        self,
        points: ArrayLike,
        radius_m: float = 0.0,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Polyline:
        """Return what a ball meets that moves along ``points`` [N, 3]: :meth:`query_segments`."""
        checked = checks.query_points(points)
        if len(checked) < 2:
            raise InvalidInputError(f"a polyline of {len(checked)} points: give two or more")
        pieces = self.query_segments(
            checked[:-1], checked[1:], radius_m, max_distance_m, at_epoch=at_epoch
        )
        return along_polyline(pieces)

    def query_rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float = 50.0,
        through_unknown: bool = False,
        at_epoch: int | None = None,
    ) -> RayRanges:
        """Return how far rays reach from ``origins`` [3] or [N, 3] along ``directions`` [N, 3].

        Args:
            origins: metres, map frame.
            directions: of any length but 0.
            max_range_m: at most 1,000 m.
            through_unknown: let unknown space not stop them.
            at_epoch: see :class:`MapQueries`.
        """
        ways = checks.directions(directions)
        starts = checks.ray_origins(origins, len(ways))
        reach_m = checks.within("max_range_m", max_range_m, MAX_RANGE_M)
        passes = checks.flag("through_unknown", through_unknown)

        def request(part: Part) -> RaysRequest:
            begin, along = part.offsets(starts), ways[part.rows].astype(np.float32)
            return RaysRequest(part.origin, begin, along, reach_m, passes, part.epoch)

        most = _ways_at_once(reach_m / RAY_M_PER_SEARCH)
        return RayRanges(**self._in_parts(request, starts, most=most, at_epoch=at_epoch).joined())

    def query_ground(
        self, points: ArrayLike, max_drop_m: float = 2.0, at_epoch: int | None = None
    ) -> Ground:
        """Return the ground below ``points`` [N, 3]: its height and slope, or that there is none.

        Args:
            points: metres, map frame, in free space above the ground, or at most half a voxel
                below it.
            max_drop_m: the ground is searched for down to here, at most 100 m.
            at_epoch: see :class:`MapQueries`.
        """
        checked = checks.query_points(points)
        drop_m = checks.within("max_drop_m", max_drop_m)

        def request(part: Part) -> GroundRequest:
            return GroundRequest(part.origin, part.offsets(checked), drop_m, epoch=part.epoch)

        most = _ways_at_once(drop_m / RAY_M_PER_SEARCH)
        fields = self._in_parts(request, checked, most=most, at_epoch=at_epoch).joined()
        return Ground(checked, height_m=checked[:, 2] - fields.pop("drop_m"), **fields)

    def align(
        self,
        points: ArrayLike,
        world_from_sensor_guess: PoseLike,
        max_distance_m: float = 6.0,
        at_epoch: int | None = None,
    ) -> Alignment:
        """Return the pose of a scan: its points are moved until they lie on surfaces of the map.

        Args:
            points: [N, 3] metres, sensor frame; any number, of which some 2,000 are used.
            world_from_sensor_guess: [4, 4]; off by a metre and ten degrees or so at most.
            max_distance_m: points farther than this from any surface do not count.
            at_epoch: see :class:`MapQueries`.
        """
        epoch, cloud = self._chosen(at_epoch), checks.scan_points(points)
        # Here, not only where it is answered: a hundredth of a scan travels.
        few = thinned(cloud.astype(np.float64), FINE_POINTS).astype(np.float32)
        guess = rigid_pose(world_from_sensor_guess)
        reach_m = checks.within("max_distance_m", max_distance_m)
        request = AlignRequest(few, guess, reach_m, epoch)
        return Alignment(**vars(self._server.ask(request)))


def _ways_at_once(searches: float) -> int:
    """Return how many ways that take as many ``searches`` each one request may ask about."""
    return max(1, min(_MOST_WAYS, int(MAX_SEARCHES / max(1.0, searches))))
