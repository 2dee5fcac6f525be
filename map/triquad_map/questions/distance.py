"""True distances to the nearest surface, at any range."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import Enum
from typing import Literal, NoReturn, TypeAlias

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import InvalidInputError, TriquadError
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats
from triquad_format.records.status import Status

from triquad_map.questions.answer import Answer
from triquad_map.surface import DISC_RADIUS
from triquad_map.view import NO_LENGTH_M, REACH_VOXELS, MapView, NearestSurface, asked

# Arrays take numbers sooner than they take members of an enumeration.
_FREE, _SURFACE, _UNKNOWN = int(Status.FREE), int(Status.SURFACE), int(Status.UNKNOWN)

_SURFEL_VOXELS = 1 + REACH_VOXELS
"""The distance from which on surfels count alone, in voxels: a voxel and its reach are no wider. Up
to the reach the trained field does."""

_WIDENED_VOXELS = float(np.sqrt(0.5)) - DISC_RADIUS
"""The way from a disc's rim to where it meets those of the next voxels, at their corners."""

Rows = NDArray[np.intp]


class UnknownSpaceError(TriquadError):
    """The query meets unknown space, which was to count as an error."""

    def __init__(self, what: str, index: int, count: int) -> None:
        others = f", and {count - 1} others do" if count > 1 else ""
        super().__init__(
            f"{what} {index} meets unknown space{others}: look there first, or let unknown space "
            "count as 'obstacle' or 'free'"
        )
        self.index = index
        self.count = count


class Unknown(str, Enum):
    """The ways in which unknown space may count."""

    OBSTACLE = "obstacle"
    FREE = "free"
    ERROR = "error"  # to meet it raises UnknownSpaceError

    @classmethod
    def _missing_(cls, value: object) -> NoReturn:
        """Refuse what is no such way, by name."""
        ways = ", ".join(repr(way.value) for way in cls)
        raise InvalidInputError(f"unknown = {value!r}: use one of {ways}")


UnknownLike: TypeAlias = Unknown | Literal["obstacle", "free", "error"]
"""An :class:`Unknown`, or its word."""


def refuse_unknown(what: str, meets: Bools) -> None:
    """Raise :class:`UnknownSpaceError` where any of N things meets unknown space."""
    if meets.any():
        raise UnknownSpaceError(what, int(meets.argmax()), int(meets.sum()))


def meets_surface(distance_m: Floats, status: Bytes, radius_m: float) -> Bools:
    """Return which of N balls around points [N] a seen surface meets, by the points' distances.

    Behind a surface distances are negative; how far, nobody knows where nobody saw.
    """
    return np.where(status == _UNKNOWN, np.abs(distance_m), distance_m) <= radius_m


def are_free(what: str, blocked: Bools, meets: Bools, unknown: UnknownLike) -> Bools:
    """Return which of N things [N] can pass, where unknown space counts as asked.

    Raises:
        UnknownSpaceError: it counts as an error, and one of them ``meets`` it.
        ValueError: ``unknown`` is no :class:`Unknown`.
    """
    if Unknown(unknown) is Unknown.ERROR:
        refuse_unknown(what, meets)
    return ~blocked if Unknown(unknown) is Unknown.FREE else ~(blocked | meets)


@dataclass(frozen=True, repr=False)
class Distances(Answer):
    """Distances from N points to the nearest seen surface, of one epoch.

    What was not asked for raises :class:`NotAskedError`.

    Attributes:
        distance_m: [N] metres, negative behind a surface; at most ``max_distance_m``.
        gradient: [N, 3] its unit gradient, map frame, pointing to free space; 0: not found.
        found: [N] False: no surface within ``max_distance_m``, which ``distance_m`` is then.
        status: [N] :class:`Status` of the points themselves.
        confidence: [N] in [0, 1]; 0 where nothing was found or the point is unknown.
    """

    distance_m: Floats
    gradient: Floats
    found: Bools
    status: Bytes
    confidence: Floats
    epoch: int
    _surface_point: Doubles | None = None
    _unknown_distance_m: Floats | None = None
    _unknown_point: Doubles | None = None

    @property
    def surface_point(self) -> Doubles:
        """[N, 3] metres, map frame: nearest point of the surface; the point itself: not found."""
        return asked("surface_point", self._surface_point, "surface_point")

    @property
    def unknown_distance_m(self) -> Floats:
        """[N] metres: distance to unknown space, at most ``max_distance_m``, 0 within it."""
        return asked("unknown_distance_m", self._unknown_distance_m, "unknown_distance")

    @property
    def unknown_point(self) -> Doubles:
        """[N, 3] metres, map frame: nearest point of unknown space, within ``max_distance_m``."""
        return asked("unknown_point", self._unknown_point, "unknown_distance")


def distances(
    view: MapView,
    points: Doubles,
    max_distance_m: float = 5.0,
    *,
    surface_point: bool = False,
    unknown_distance: bool = False,
) -> Distances:
    """Return distances from ``points`` [N, 3], metres, map frame, to the nearest seen surface.

    It is searched for up to ``max_distance_m``; its nearest points and the nearest unknown space
    are part of the answer where they are asked for.
    """
    nearest = view.nearest_surface(points, max_distance_m)
    status = view.status(points)
    gradient, distance = nearest.gradient, nearest.distance  # from here on, of the answer
    near = (distance < _SURFEL_VOXELS * view.voxel_m) & (status == _SURFACE) & nearest.found
    learnt, unlearnt = np.flatnonzero(near & nearest.learnt), np.flatnonzero(near & ~nearest.learnt)
    _join_field(view, points, learnt, distance=distance, gradient=gradient)
    _join_rays(view, points, unlearnt, nearest=nearest, distance=distance, gradient=gradient)
    # What the field or the rays say may lie beyond a limit that is close by.
    np.clip(distance, -max_distance_m, max_distance_m, out=distance)
    unknown = None
    if unknown_distance:
        unknown = view.nearest_unknown(points, max_distance_m)
    met = np.where(nearest.found[:, None], nearest.point, points) if surface_point else None
    return Distances(
        distance_m=distance.astype(np.float32),
        gradient=gradient.astype(np.float32),
        found=nearest.found,
        status=status,
        confidence=np.where(status == _UNKNOWN, np.float32(0), nearest.confidence),
        epoch=view.epoch,
        _surface_point=met,
        _unknown_distance_m=None if unknown is None else unknown.distance.astype(np.float32),
        _unknown_point=None if unknown is None else unknown.point,
    )


def with_unknown(answer: Distances, points: Doubles, unknown: Unknown) -> Distances:
    """Return the answer for ``points`` [N, 3] where unknown space counts as asked.

    As an obstacle it is a surface like others, of confidence 0.

    Raises:
        UnknownSpaceError: it is to be an error, and lies nearer than a surface.
    """
    if unknown is Unknown.FREE:
        return answer
    nearer = answer.unknown_distance_m < answer.distance_m
    if unknown is Unknown.ERROR:
        refuse_unknown("point", nearer)
    gradient = _unit(points - answer.unknown_point)
    surface_point = answer._surface_point
    if surface_point is not None:
        surface_point = np.where(nearer[:, None], answer.unknown_point, surface_point)
    return dataclasses.replace(
        answer,
        distance_m=np.where(nearer, answer.unknown_distance_m, answer.distance_m),
        gradient=np.where(nearer[:, None], gradient, answer.gradient).astype(np.float32),
        found=answer.found | nearer,
        confidence=np.where(nearer, np.float32(0), answer.confidence),
        _surface_point=surface_point,
    )


def _join_field(
    view: MapView, points: Doubles, rows: Rows, distance: Doubles, gradient: Doubles
) -> None:
    """Take the side of ``rows`` near a surface from the field, and gradually its value."""
    if not len(rows):
        return
    low, high = REACH_VOXELS * view.voxel_m, _SURFEL_VOXELS * view.voxel_m
    field = view.query(points[rows], gradient=True)
    usable = np.isfinite(field.sdf) & (np.abs(field.gradient).max(axis=1) > 0)
    rows = rows[usable]
    value = field.sdf[usable].astype(np.float64)
    slope = _unit(field.gradient[usable].astype(np.float64))
    share = _surfel_share(view, distance[rows])
    behind = value < 0
    # Nowhere that rays passed and none ended: a field that is flat there may dip below zero.
    behind[behind] = view.status(points[rows[behind]], reach_m=0.0) != _FREE
    side = np.where(behind, -1.0, 1.0)
    # The field is no more than a bound where it saturates.
    value = np.clip(value, -high, distance[rows] + low)
    joined = share[:, None] * side[:, None] * gradient[rows] + (1 - share)[:, None] * slope
    distance[rows] = share * side * distance[rows] + (1 - share) * value
    gradient[rows] = _unit(joined, slope)


def _join_rays(
    view: MapView,
    points: Doubles,
    rows: Rows,
    nearest: NearestSurface,
    distance: Doubles,
    gradient: Doubles,
) -> None:
    """Find sides and close gaps at ``rows`` near a surface that the field has not learnt.

    A disc is widened there up to the corners of its voxel, where it meets those next to it.
    """
    if not len(rows):
        return
    normal = nearest.normal[rows].astype(np.float64)
    height = ((points[rows] - nearest.point[rows]) * normal).sum(axis=1)
    beside = np.sqrt(np.maximum(distance[rows] ** 2 - height**2, 0.0))
    beyond = np.maximum(beside - _WIDENED_VOXELS * view.voxel_m, 0.0)
    close = np.hypot(height, beyond)
    is_point = ~normal.any(axis=1)
    close[is_point] = distance[rows[is_point]] - DISC_RADIUS * view.voxel_m
    below = points[rows] - height[:, None] * normal  # the points, moved onto the planes
    ended = view.status(below, reach_m=0.0) == _SURFACE  # else beyond an edge
    behind = ended & (height < 0) & (height > -REACH_VOXELS * view.voxel_m) & (beyond == 0)
    side = np.where(behind, -1.0, 1.0)
    share = _surfel_share(view, distance[rows])
    distance[rows] = side * (share * distance[rows] + (1 - share) * close)
    # Over the disc itself the direction is its normal's, which is 0 for a point.
    upright = np.where(beyond == 0, (1 - share) * np.where(height < 0, -side, side), 0.0)
    away = np.where((beyond == 0) & ~is_point, share, 1.0) * side
    joined = away[:, None] * gradient[rows] + upright[:, None] * normal
    gradient[rows] = _unit(joined, normal)


def _surfel_share(view: MapView, distance: Doubles) -> Doubles:
    """Return how much the distance to the surfels counts there [N]: from 0 to 1, without a kink."""
    low, high = REACH_VOXELS * view.voxel_m, _SURFEL_VOXELS * view.voxel_m
    share = np.clip((distance - low) / (high - low), 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share), np.float64)


def _unit(vectors: Doubles, otherwise: Doubles | float = 0.0) -> Doubles:
    """Return directions [N, 3] of ``vectors`` [N, 3]; ``otherwise`` where they have no length."""
    lengths = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    directions: Doubles = vectors / np.maximum(lengths, NO_LENGTH_M)[:, None]
    short = lengths <= NO_LENGTH_M
    if short.any():
        directions[short] = np.broadcast_to(otherwise, vectors.shape)[short]
    return directions
