"""Turns the message of a question into the message of its answer, for any map.

A server answers with this from its epochs, and a client from a map file: so the two cannot differ.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.wire.codec import ReplyT, Request
from triquad_format.wire.limits import (
    MAX_POSITION_M,
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

from triquad_map.questions.align import align
from triquad_map.questions.bodies import segments, spheres
from triquad_map.questions.distance import distances
from triquad_map.questions.grid import GridShape, grid
from triquad_map.questions.ground import ground
from triquad_map.questions.rays import rays
from triquad_map.view import MapView

_DECIMALS = 5  # of positions, metres

Views = Callable[[int], AbstractContextManager[MapView]]
"""The map of the epoch of some number, 0 for the newest, while it is asked."""


class Answers:
    """Answers questions; as many threads may ask as the views allow."""

    def __init__(self, views: Views) -> None:
        self._view = views

    def answer(self, request: Request[ReplyT]) -> ReplyT:
        """Return the answer to a question of any kind, whose fields are within their bounds.

        Raises:
            RefusedError: it is too large, what it says does not go together, or its epoch is not
                kept; it says which argument cannot be used.
            KeyError: it is no question about the map.
        """
        question: Any = request
        answer = QUESTIONS[type(request)]
        with self._view(question.epoch) as view:
            reply: ReplyT = answer(view, question)
        return reply


def _sdf(view: MapView, request: SdfRequest) -> SdfReply:
    points = _points("point", request.origin, request.points, most=MAX_QUERY_POINTS)
    return _reply(SdfReply, view.query(points, request.gradient), epoch=view.epoch)


def _distance(view: MapView, request: DistanceRequest) -> DistanceReply:
    points = _searched("point", request.origin, request.points)
    answer = distances(
        view,
        points,
        request.max_distance_m,
        surface_point=request.surface_point,
        unknown_distance=request.unknown_distance,
    )
    return _reply(
        DistanceReply,
        answer,
        surface_point=_relative(answer._surface_point, request.origin),
        unknown_point=_relative(answer._unknown_point, request.origin),
    )


def _spheres(view: MapView, request: SpheresRequest) -> SpheresReply:
    centres = _searched("sphere", request.origin, request.centres)
    return _reply(SpheresReply, spheres(view, centres, request.radii_m.astype(np.float64)))


def _segments(view: MapView, request: SegmentsRequest) -> SegmentsReply:
    starts = _searched("start", request.origin, request.starts)
    ends = _searched("end", request.origin, request.ends)
    lengths = np.linalg.norm(ends - starts, axis=1)
    if lengths.max(initial=0.0) > MAX_RANGE_M:  # each step waits for the one before
        worst = int(lengths.argmax())
        raise RefusedError(
            "bad_request",
            f"segment {worst} is {lengths[worst]:g} m long: use at most {MAX_RANGE_M:g} m",
        )
    total_m = float(lengths.sum())
    _check_count(total_m / SEGMENT_M_PER_SEARCH, f"segments of {total_m:.0f} m in all")
    most_m = request.max_distance_m
    return _reply(
        SegmentsReply, segments(view, starts, ends, request.radius_m, max_distance_m=most_m)
    )


def _rays(view: MapView, request: RaysRequest) -> RaysReply:
    starts = _searched("start", request.origin, request.starts)
    directions = request.directions.astype(np.float64)
    lengths = np.linalg.norm(directions, axis=1)
    bad = ~(np.abs(lengths - 1.0) < 1e-3)
    if bad.any():
        worst = int(bad.argmax())
        raise RefusedError("bad_request", f"direction {worst} has length {lengths[worst]:g}, not 1")
    reach_m = request.max_range_m
    _check_count(len(starts) * reach_m / RAY_M_PER_SEARCH, f"{len(starts)} rays of {reach_m:g} m")
    directions /= lengths[:, None]
    return _reply(RaysReply, rays(view, starts, directions, reach_m, request.through_unknown))


def _ground(view: MapView, request: GroundRequest) -> GroundReply:
    points = _searched("point", request.origin, request.points)
    drop_m = request.max_drop_m
    _check_count(
        len(points) * drop_m / RAY_M_PER_SEARCH, f"{len(points)} points with {drop_m:g} m below"
    )
    answer = ground(view, points, drop_m)
    below_m = (points[:, 2] - answer.height_m).astype(np.float32)
    return _reply(GroundReply, answer, drop_m=below_m)


def _grid(view: MapView, request: GridRequest) -> GridReply:
    counts = (int(request.counts[0]), int(request.counts[1]), int(request.counts[2]))
    shape = GridShape(request.corner, request.cell_m, counts)
    _check_count(shape.cells, f"{shape.cells} cells")
    return _reply(GridReply, grid(view, shape, request.max_distance_m))


def _align(view: MapView, request: AlignRequest) -> AlignReply:
    _check_count(len(request.points), f"{len(request.points)} points")
    points = request.points.astype(np.float64)
    answer = align(view, points, request.world_from_sensor, request.max_distance_m)
    return _reply(AlignReply, answer)


QUESTIONS: dict[type[Request[Any]], Callable[[MapView, Any], Any]] = {
    SdfRequest: _sdf,
    DistanceRequest: _distance,
    SpheresRequest: _spheres,
    SegmentsRequest: _segments,
    RaysRequest: _rays,
    GroundRequest: _ground,
    GridRequest: _grid,
    AlignRequest: _align,
}
"""All questions about the map, and what makes their answers."""


def _points(what: str, origin: Doubles, offsets: Floats, most: int) -> Doubles:
    """Return the points [N, 3] at ``offsets`` [N, 3] from an origin [3], map frame.

    Raises:
        RefusedError: they are too many, or not all of them are places.
    """
    if len(offsets) > most:
        raise RefusedError(
            "too_large", f"{len(offsets)} points exceed the limit of {most}: split the request"
        )
    points = origin + offsets.astype(np.float64)
    # Of NaN, neither is true.
    if points.min(initial=0.0) >= -MAX_POSITION_M and points.max(initial=0.0) <= MAX_POSITION_M:
        # Single precision from an origin is good to that. Unrounded, a point that somebody chose on
        # a face of voxels would lie on one side or the other by what else is in the request.
        rounded: Doubles = np.round(points, _DECIMALS)
        return rounded
    index = int((np.abs(points) <= MAX_POSITION_M).all(axis=1).argmin())
    if not np.isfinite(points[index]).all():
        raise RefusedError("bad_request", f"{what} {index} is not finite: {points[index]}")
    raise RefusedError(
        "bad_request",
        f"{what} {index} is {points[index]}: use coordinates up to {MAX_POSITION_M:g} m",
    )


def _searched(what: str, origin: Doubles, offsets: Floats) -> Doubles:
    return _points(what, origin, offsets, most=MAX_SEARCHES)


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
