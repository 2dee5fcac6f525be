"""Turns the message of a question into the message of its answer, for any map.

A server answers with this from its epochs, and a client from a map file: so the two cannot differ.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.pose import is_rigid
from triquad_format.wire import keys
from triquad_format.wire.codec import Message
from triquad_format.wire.limits import (
    MAX_DISTANCE_M,
    MAX_QUERY_POINTS,
    MAX_RANGE_M,
    MAX_SEARCHES,
    RAY_M_PER_SEARCH,
    SEGMENT_M_PER_SEARCH,
)
from triquad_format.wire.messages import SdfReply, SdfRequest
from triquad_format.wire.query_messages import (
    AlignReply,
    AlignRequest,
    DistanceReply,
    DistanceRequest,
    GridReply,
    GridRequest,
    GroundReply,
    GroundRequest,
    RaysReply,
    RaysRequest,
    SegmentsReply,
    SegmentsRequest,
    SpheresReply,
    SpheresRequest,
)

from triquad_map.questions import checks
from triquad_map.questions.align import align
from triquad_map.questions.distance import DistanceOptions, distances
from triquad_map.questions.grid import GridShape, grid
from triquad_map.questions.ground import ground
from triquad_map.questions.rays import rays
from triquad_map.questions.segments import segments
from triquad_map.questions.spheres import spheres
from triquad_map.view import MapView

ReplyT = TypeVar("ReplyT", bound=Message)

Views = Callable[[int], AbstractContextManager[MapView]]
"""The map of the epoch of some number, 0 for the newest, while it is asked."""


class Answers:
    """Answers questions; as many threads may ask as the views allow.

    Whatever is asked for, :class:`RefusedError` says which argument is out of bounds.
    """

    def __init__(self, views: Views) -> None:
        self._view = views

    def answer(self, request: Message) -> Message:
        """Return the answer to a question of any kind.

        Raises:
            RefusedError: an argument is out of bounds, or its epoch is not kept.
            KeyError: it is no question about the map.
        """
        return _ANSWERS[type(request)](self, request)

    def sdf(self, request: SdfRequest) -> SdfReply:
        """Return the trained field, and status."""
        points = checks.points("point", request.origin, request.points, most=MAX_QUERY_POINTS)
        with self._view(request.epoch) as view:
            answer = view.query(points, request.gradient)
            return _reply(SdfReply, answer, epoch=view.epoch)

    def distance(self, request: DistanceRequest) -> DistanceReply:
        """Return distances to the nearest surface."""
        points = _searched("point", request.origin, request.points)
        reach_m = checks.within("max_distance_m", request.max_distance_m, MAX_DISTANCE_M)
        options = DistanceOptions(reach_m, request.surface_point, request.unknown_distance)
        with self._view(request.epoch) as view:
            answer = distances(view, points, options)
        return _reply(
            DistanceReply,
            answer,
            surface_point=_relative(answer._surface_point, request.origin),
            unknown_point=_relative(answer._unknown_point, request.origin),
        )

    def spheres(self, request: SpheresRequest) -> SpheresReply:
        """Return what spheres contain."""
        centres = _searched("sphere", request.origin, request.centres)
        checks.same_length(request.centres, "radii_m", request.radii_m)
        good = (request.radii_m >= 0) & (request.radii_m <= MAX_DISTANCE_M)
        if not good.all():
            worst = int((~good).argmax())
            raise RefusedError(
                "bad_request",
                f"radius {worst} is {request.radii_m[worst]}: use 0 to {MAX_DISTANCE_M:g} m",
            )
        with self._view(request.epoch) as view:
            answer = spheres(view, centres, request.radii_m.astype(np.float64))
        return _reply(SpheresReply, answer)

    def segments(self, request: SegmentsRequest) -> SegmentsReply:
        """Return what a ball meets on segments."""
        starts = _searched("start", request.origin, request.starts)
        checks.same_length(request.starts, "ends", request.ends)
        ends = _searched("end", request.origin, request.ends)
        radius_m = checks.within("radius_m", request.radius_m, MAX_DISTANCE_M, least=0.0)
        reach_m = checks.within("max_distance_m", request.max_distance_m, MAX_DISTANCE_M)
        lengths = np.linalg.norm(ends - starts, axis=1)
        if lengths.max(initial=0.0) > MAX_RANGE_M:  # each step waits for the one before
            worst = int(lengths.argmax())
            raise RefusedError(
                "bad_request",
                f"segment {worst} is {lengths[worst]:g} m long: use at most {MAX_RANGE_M:g} m",
            )
        total_m = float(lengths.sum())
        _check_count(total_m / SEGMENT_M_PER_SEARCH, f"segments of {total_m:.0f} m in all")
        with self._view(request.epoch) as view:
            answer = segments(view, starts, ends, radius_m, max_distance_m=reach_m)
        return _reply(SegmentsReply, answer)

    def rays(self, request: RaysRequest) -> RaysReply:
        """Return how far rays reach."""
        starts = _searched("start", request.origin, request.starts)
        checks.same_length(request.starts, "directions", request.directions)
        directions = request.directions.astype(np.float64)
        lengths = np.linalg.norm(directions, axis=1)
        bad = ~(np.abs(lengths - 1.0) < 1e-3)
        if bad.any():
            worst = int(bad.argmax())
            raise RefusedError(
                "bad_request", f"direction {worst} has length {lengths[worst]:g}, not 1"
            )
        reach_m = checks.within("max_range_m", request.max_range_m, MAX_RANGE_M)
        _check_count(
            len(starts) * reach_m / RAY_M_PER_SEARCH, f"{len(starts)} rays of {reach_m:g} m"
        )
        directions /= lengths[:, None]
        with self._view(request.epoch) as view:
            answer = rays(view, starts, directions, reach_m, request.through_unknown)
        return _reply(RaysReply, answer)

    def ground(self, request: GroundRequest) -> GroundReply:
        """Return what lies below points."""
        points = _searched("point", request.origin, request.points)
        drop_m = checks.within("max_drop_m", request.max_drop_m, MAX_DISTANCE_M)
        _check_count(
            len(points) * drop_m / RAY_M_PER_SEARCH, f"{len(points)} points with {drop_m:g} m below"
        )
        with self._view(request.epoch) as view:
            answer = ground(view, points, drop_m)
        below_m = (points[:, 2] - answer.height_m).astype(np.float32)
        return _reply(GroundReply, answer, drop_m=below_m)

    def grid(self, request: GridRequest) -> GridReply:
        """Return distance and status at a grid's cells."""
        counts = (int(request.counts[0]), int(request.counts[1]), int(request.counts[2]))
        cell_m = checks.within("cell_m", request.cell_m, MAX_DISTANCE_M)
        if min(counts) < 1 or not np.isfinite(request.corner).all():
            raise RefusedError(
                "bad_request", f"not a grid: counts {counts}, corner {request.corner}"
            )
        shape = GridShape(request.corner, cell_m, counts)
        _check_count(shape.cells, f"{shape.cells} cells")
        reach_m = checks.within("max_distance_m", request.max_distance_m, MAX_DISTANCE_M)
        with self._view(request.epoch) as view:
            answer = grid(view, shape, reach_m)
        return _reply(GridReply, answer)

    def align(self, request: AlignRequest) -> AlignReply:
        """Return the pose of a scan near a guess."""
        _check_count(len(request.points), f"{len(request.points)} points")
        if not is_rigid(request.world_from_sensor):
            raise RefusedError(
                "bad_request",
                f"world_from_sensor is no rotation and translation: {request.world_from_sensor}",
            )
        reach_m = checks.within("max_distance_m", request.max_distance_m, MAX_DISTANCE_M)
        with self._view(request.epoch) as view:
            points = request.points.astype(np.float64)
            answer = align(view, points, request.world_from_sensor, reach_m)
        return _reply(AlignReply, answer)


@dataclass(frozen=True)
class Question:
    """A question about the map: its message, and what makes the answer of it."""

    request: type[Message]
    answer: Callable[[Answers, Any], Message]


QUESTIONS = {
    keys.SDF: Question(SdfRequest, Answers.sdf),
    keys.DISTANCE: Question(DistanceRequest, Answers.distance),
    keys.SPHERES: Question(SpheresRequest, Answers.spheres),
    keys.SEGMENTS: Question(SegmentsRequest, Answers.segments),
    keys.RAYS: Question(RaysRequest, Answers.rays),
    keys.GROUND: Question(GroundRequest, Answers.ground),
    keys.GRID: Question(GridRequest, Answers.grid),
    keys.ALIGN: Question(AlignRequest, Answers.align),
}
"""All questions about the map, by their operations."""

_ANSWERS = {question.request: question.answer for question in QUESTIONS.values()}


def _searched(what: str, origin: Doubles, offsets: Floats) -> Doubles:
    return checks.points(what, origin, offsets, most=MAX_SEARCHES)


def _check_count(count: float, what: str) -> None:
    if count > MAX_SEARCHES:
        raise RefusedError(
            "too_large", f"{what} exceed the limit of {MAX_SEARCHES} searches: split the request"
        )


def _reply(kind: type[ReplyT], answer: object, **given: object) -> ReplyT:
    """Return a reply whose fields are those of an answer, but for what is given otherwise.

    An answer has what was not always asked for under a name with an underscore before it.
    """
    there = {name.removeprefix("_"): value for name, value in vars(answer).items()} | given
    fields: dict[str, Any] = {name: there[name] for name in kind.forms()}
    for name, value in fields.items():
        if isinstance(value, np.ndarray) and value.dtype == np.bool_:
            fields[name] = value.astype(np.uint8)
    return kind(**fields)


def _relative(points: Doubles | None, origin: Doubles) -> Floats | None:
    return None if points is None else (points - origin).astype(np.float32)
