"""Questions about the map: arguments checked, asked in parts of one epoch, and the replies joined.

Positions are metres in the map frame, where nothing else is said. ``at_epoch`` is the number of an
epoch; ``None`` is the newest. What cannot be asked raises :class:`InvalidInputError`.
:mod:`triquad_map.questions.answers` is the other side.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Doubles
from triquad_format.wire import keys
from triquad_format.wire.limits import (
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
from triquad_map.questions.align import FINE_POINTS, Alignment, AlignOptions, thinned
from triquad_map.questions.distance import (
    DistanceOptions,
    Distances,
    Unknown,
    UnknownLike,
    with_unknown,
)
from triquad_map.questions.grid import Grid
from triquad_map.questions.ground import Ground
from triquad_map.questions.rays import RayOptions, RayRanges
from triquad_map.questions.segments import Polyline, SegmentOptions, Segments, along_polyline
from triquad_map.questions.spheres import Spheres
from triquad_map.view import asked

from triquad_client import checks
from triquad_client.calls.parts import in_parts, joined, offsets_from, origin_of
from triquad_client.checks import Bounds, PoseLike
from triquad_client.net.call import NEWEST, Ask, Call, ask, offload, retried

_MOST_WAYS = 1_000
"""Segments, rays or columns down to the ground of one request, however short they are."""


@dataclass(frozen=True)
class SdfResult:
    """The field and the status of N points, all of it from one epoch."""

    sdf: NDArray[np.float32]  # [N] metres, positive in free space; NaN where the map has nothing
    status: NDArray[np.uint8]  # [N] Status values
    epoch: int
    _gradient: NDArray[np.float32] | None = None

    @property
    def gradient(self) -> NDArray[np.float32]:
        """[N, 3] d(sdf)/dx, map frame, pointing to free space.

        Raises:
            NotAskedError: it was not asked for.
        """
        return asked("gradient", self._gradient, "gradient")


def sdf(points: ArrayLike, gradient: bool, at_epoch: int | None) -> Call[SdfResult]:
    """Return the trained field at ``points`` [N, 3]."""
    gradient = checks.flag("gradient", gradient)
    if isinstance(points, np.ndarray) and points.size > 3 * MAX_QUERY_POINTS:
        checked = yield from offload(lambda _: checks.query_points(points))
    else:
        checked = checks.query_points(points)

    def request(part: slice, epoch: int) -> Ask[SdfReply]:
        return _ask_sdf(checked[part], gradient, epoch)

    parts = yield from in_parts(request, len(checked), most=MAX_QUERY_POINTS, at_epoch=at_epoch)
    asked_for = {"gradient": gradient}
    if len(parts) == 1:
        return SdfResult(**joined(parts, asked_for=asked_for))
    return (yield from offload(lambda _: SdfResult(**joined(parts, asked_for=asked_for))))


def pin_newest() -> Call[int]:
    """Return the newest epoch, once the server keeps it for us: it was asked for by number."""
    nowhere = np.zeros((0, 3))

    def pin() -> Call[int]:
        newest = yield from ask(_ask_sdf(nowhere, False, NEWEST))
        return (yield from ask(_ask_sdf(nowhere, False, newest.epoch))).epoch

    return (yield from retried("epoch_gone", pin))


def _ask_sdf(points: Doubles, gradient: bool, epoch: int) -> Ask[SdfReply]:
    origin = origin_of(points)
    request = SdfRequest(origin, offsets_from(points, origin), gradient=gradient, epoch=epoch)
    return Ask(keys.SDF, request, SdfReply)


def distance(
    points: ArrayLike, options: DistanceOptions, unknown: UnknownLike, at_epoch: int | None
) -> Call[Distances]:
    """Return true distances to the nearest surface at ``points`` [N, 3]."""
    checked = checks.query_points(points)
    policy = checks.unknown_policy(unknown)
    surface_point = checks.flag("surface_point", options.surface_point)
    asked_distance = checks.flag("unknown_distance", options.unknown_distance)
    unknown_distance = asked_distance or policy is not Unknown.FREE
    reach_m = checks.within("max_distance_m", options.max_distance_m)

    def request(part: slice, epoch: int) -> Ask[DistanceReply]:
        origin = origin_of(checked[part])
        message = DistanceRequest(
            origin=origin,
            points=offsets_from(checked[part], origin),
            max_distance_m=reach_m,
            surface_point=surface_point,
            unknown_distance=unknown_distance,
            epoch=epoch,
        )
        return Ask(keys.DISTANCE, message, DistanceReply)

    parts = yield from in_parts(request, len(checked), most=MAX_SEARCHES, at_epoch=at_epoch)
    asked_for = {
        "surface_point": surface_point,
        "unknown_distance_m": unknown_distance,
        "unknown_point": unknown_distance,
    }
    fields = joined(parts, flags=["found"], asked_for=asked_for)
    for name in ("_surface_point", "_unknown_point"):
        if fields[name] is not None:
            fields[name] = fields[name] + _origins(checked, [len(part.found) for part in parts])
    return with_unknown(Distances(**fields), checked, policy)


def _origins(points: Doubles, counts: list[int]) -> Doubles:
    """Return the origin [N, 3] from which each point of N was sent, in parts of ``counts``."""
    starts = range(0, max(1, len(points)), MAX_SEARCHES)
    origins = [origin_of(points[start : start + MAX_SEARCHES]) for start in starts]
    return np.repeat(origins, counts, axis=0)


def spheres(centres: ArrayLike, radii_m: ArrayLike, at_epoch: int | None) -> Call[Spheres]:
    """Return what spheres around ``centres`` [N, 3] contain; ``radii_m`` are one number or [N]."""
    checked = checks.query_points(centres)
    radii = checks.radii(radii_m, len(checked))

    def request(part: slice, epoch: int) -> Ask[SpheresReply]:
        origin = origin_of(checked[part])
        message = SpheresRequest(
            origin, offsets_from(checked[part], origin), radii[part], epoch=epoch
        )
        return Ask(keys.SPHERES, message, SpheresReply)

    parts = yield from in_parts(request, len(checked), most=MAX_SEARCHES, at_epoch=at_epoch)
    return Spheres(**joined(parts))


def segments(
    starts: ArrayLike, ends: ArrayLike, options: SegmentOptions, at_epoch: int | None
) -> Call[Segments]:
    """Return what a ball meets that moves from ``starts`` to ``ends`` [N, 3]."""
    first, last = checks.query_points(starts), checks.query_points(ends)
    if len(first) != len(last):
        raise InvalidInputError(f"{len(first)} starts and {len(last)} ends: give as many")
    radius_m = checks.within("radius_m", options.radius_m, least=0.0)
    reach_m = checks.within("max_distance_m", options.max_distance_m)

    def request(part: slice, epoch: int) -> Ask[SegmentsReply]:
        origin = origin_of(first[part])
        message = SegmentsRequest(
            origin=origin,
            starts=offsets_from(first[part], origin),
            ends=offsets_from(last[part], origin),
            radius_m=radius_m,
            max_distance_m=reach_m,
            epoch=epoch,
        )
        return Ask(keys.SEGMENTS, message, SegmentsReply)

    longest_m = float(np.linalg.norm(last - first, axis=1).max(initial=0.0))
    most = _ways_at_once(longest_m / SEGMENT_M_PER_SEARCH)
    parts = yield from in_parts(request, len(first), most=most, at_epoch=at_epoch)
    return Segments(**joined(parts, flags=["blocked", "meets_unknown"]))


def _ways_at_once(searches: float) -> int:
    """Return how many ways that take as many ``searches`` each one request may ask about."""
    return max(1, min(_MOST_WAYS, int(MAX_SEARCHES / max(1.0, searches))))


def polyline(points: ArrayLike, options: SegmentOptions, at_epoch: int | None) -> Call[Polyline]:
    """Return what a ball meets that moves along ``points`` [N, 3]."""
    checked = checks.query_points(points)
    if len(checked) < 2:
        raise InvalidInputError(f"a polyline of {len(checked)} points: give two or more")
    pieces = yield from segments(checked[:-1], checked[1:], options, at_epoch=at_epoch)
    return along_polyline(pieces)


def rays(
    origins: ArrayLike, directions: ArrayLike, options: RayOptions, at_epoch: int | None
) -> Call[RayRanges]:
    """Return how far rays reach from ``origins`` [3] or [N, 3] along ``directions`` [N, 3]."""
    ways = checks.directions(directions)
    starts = checks.ray_origins(origins, len(ways))
    reach_m = checks.within("max_range_m", options.max_range_m, MAX_RANGE_M)
    through_unknown = checks.flag("through_unknown", options.through_unknown)

    def request(part: slice, epoch: int) -> Ask[RaysReply]:
        origin = origin_of(starts[part])
        message = RaysRequest(
            origin=origin,
            starts=offsets_from(starts[part], origin),
            directions=ways[part].astype(np.float32),
            max_range_m=reach_m,
            through_unknown=through_unknown,
            epoch=epoch,
        )
        return Ask(keys.RAYS, message, RaysReply)

    most = _ways_at_once(reach_m / RAY_M_PER_SEARCH)
    parts = yield from in_parts(request, len(ways), most=most, at_epoch=at_epoch)
    return RayRanges(**joined(parts))


def ground(points: ArrayLike, max_drop_m: float, at_epoch: int | None) -> Call[Ground]:
    """Return what lies at most ``max_drop_m`` below ``points`` [N, 3]."""
    checked = checks.query_points(points)
    drop_m = checks.within("max_drop_m", max_drop_m)

    def request(part: slice, epoch: int) -> Ask[GroundReply]:
        origin = origin_of(checked[part])
        message = GroundRequest(
            origin, offsets_from(checked[part], origin), max_drop_m=drop_m, epoch=epoch
        )
        return Ask(keys.GROUND, message, GroundReply)

    most = _ways_at_once(drop_m / RAY_M_PER_SEARCH)
    parts = yield from in_parts(request, len(checked), most=most, at_epoch=at_epoch)
    fields = joined(parts)
    return Ground(height_m=checked[:, 2] - fields.pop("drop_m"), **fields)


def grid(bounds: Bounds, cell_m: float, max_distance_m: float, at_epoch: int | None) -> Call[Grid]:
    """Return the map at the cells that fill ``bounds``; a flat box is one layer of them."""
    shape = checks.grid_shape(bounds, cell_m)
    reach_m = checks.within("max_distance_m", max_distance_m)
    blocks = _blocks(shape.counts)

    def request(part: slice, epoch: int) -> Ask[GridReply]:
        (block,) = blocks[part]
        corner = shape.corner + np.array(block.first) * shape.cell_m
        counts = np.array(block.counts, np.int32)
        message = GridRequest(corner, shape.cell_m, counts, max_distance_m=reach_m, epoch=epoch)
        return Ask(keys.GRID, message, GridReply)

    replies = yield from in_parts(request, len(blocks), most=1, at_epoch=at_epoch)
    flat = [
        replace(reply, distance_m=reply.distance_m.ravel(), status=reply.status.ravel())
        for reply in replies
    ]
    fields = joined(flat)
    for name in ("distance_m", "status"):
        fields[name] = fields[name].reshape(shape.counts)
    return Grid(shape, **fields)


@dataclass(frozen=True)
class _Block:
    """Cells of a grid that lie one after the other, z running fastest."""

    first: tuple[int, int, int]
    counts: tuple[int, int, int]


def _blocks(counts: tuple[int, int, int]) -> list[_Block]:
    """Return a grid in blocks for one request each: layers of one x each, or parts of one."""
    columns, rows, height = counts
    rows_each = min(rows, max(1, MAX_SEARCHES // height))
    columns_each = max(1, MAX_SEARCHES // (rows * height))
    return [
        _Block((x, y, 0), (min(columns_each, columns - x), min(rows_each, rows - y), height))
        for x in range(0, columns, columns_each)
        for y in range(0, rows, rows_each)
    ]


def align(
    points: ArrayLike, guess: PoseLike, options: AlignOptions, at_epoch: int | None
) -> Call[Alignment]:
    """Return the pose of ``points`` [N, 3], metres, sensor frame, near a guess [4, 4]."""
    epoch = checks.chosen_epoch(at_epoch)
    cloud = checks.scan_points(points)
    # Here, not only where it is answered: a hundredth of a scan travels.
    few = yield from offload(lambda _: thinned(cloud.astype(np.float64), FINE_POINTS))
    request = AlignRequest(
        points=few.astype(np.float32),
        world_from_sensor=checks.rigid_pose(guess),
        max_distance_m=checks.within("max_distance_m", options.max_distance_m),
        max_iterations=options.max_iterations,
        epoch=epoch,
    )
    reply = yield from ask(Ask(keys.ALIGN, request, AlignReply))
    return Alignment(**vars(reply))
