"""The contacts of a robot's body: of spheres, and of a ball that moves along straight segments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats
from triquad_format.records.status import Status

from triquad_map.questions.answer import Answer
from triquad_map.questions.distance import (
    Unknown,
    UnknownLike,
    are_free,
    distances,
)
from triquad_map.view import REACH_VOXELS, MapView


@dataclass(frozen=True, repr=False)
class Spheres(Answer):
    """The content of N spheres, of one epoch.

    ``SURFACE``: a seen surface reaches into the sphere, or it lies behind one. ``UNKNOWN``: none
    does, but unknown space. ``FREE``: all of it was seen to be free.

    Attributes:
        status: [N] :class:`Status`, as above.
    """

    _things: ClassVar[str] = "spheres"
    status: Bytes
    epoch: int

    def free(self, unknown: UnknownLike = Unknown.OBSTACLE) -> Bools:
        """Return whether each sphere [N] can be entered, where unknown space counts as asked.

        Raises:
            UnknownSpaceError: it counts as an error, and a sphere without a surface meets it.
            ValueError: ``unknown`` is no :class:`Unknown`.
        """
        blocked, meets = self.status == Status.SURFACE, self.status == Status.UNKNOWN
        return are_free("sphere", blocked, meets, unknown)


def spheres(view: MapView, centres: Doubles, radii: Doubles) -> Spheres:
    """Return what spheres around ``centres`` [N, 3] of ``radii`` [N] contain, metres, map frame."""
    # A little beyond the largest, so that what touches it is found.
    reach_m = float(radii.max(initial=0.0)) + view.voxel_m
    answer = distances(view, centres, reach_m, unknown_distance=True)
    status = np.full(len(centres), Status.FREE, np.uint8)
    status[(answer.unknown_distance_m < radii) | (answer.status == Status.UNKNOWN)] = Status.UNKNOWN
    status[answer.found & (answer.distance_m <= radii)] = Status.SURFACE
    return Spheres(status, view.epoch)


@dataclass(frozen=True, repr=False)
class Segments(Answer):
    """The contacts of a ball on N segments, of one epoch.

    Places are metres along the segment from its start.

    Attributes:
        length_m: [N] metres.
        blocked: [N] whether the ball touches a seen surface.
        contact_m: [N] place where it first does; the length where it does not.
        clearance_m: [N] metres: the least distance of the ball's centre to a surface up to there,
            at most ``max_distance_m``; it is right within half a step of half a voxel.
        clearance_at_m: [N] place of that.
        meets_unknown: [N] whether the ball enters unknown space, before any contact.
        unknown_contact_m: [N] place where it first does; the length where it does not.
    """

    _things: ClassVar[str] = "segments"
    length_m: Floats
    blocked: Bools
    contact_m: Floats
    clearance_m: Floats
    clearance_at_m: Floats
    meets_unknown: Bools
    unknown_contact_m: Floats
    epoch: int

    def free(self, unknown: UnknownLike = Unknown.OBSTACLE) -> Bools:
        """Return whether the ball can pass each segment [N], where unknown space counts as asked.

        Raises:
            UnknownSpaceError: it counts as an error, and is met before any contact.
            ValueError: ``unknown`` is no :class:`Unknown`.
        """
        return are_free("segment", self.blocked, self.meets_unknown, unknown)

    def _told(self) -> str:
        return f"{self.blocked.sum()} blocked, {self.meets_unknown.sum()} meet unknown space"


@dataclass(frozen=True)
class _March:
    """The progress of a walk along N segments."""

    blocked: Bools
    contact: Doubles
    clearance: Doubles
    clearance_at: Doubles


def segments(
    view: MapView, starts: Doubles, ends: Doubles, radius_m: float, max_distance_m: float
) -> Segments:
    """Return what a ball meets that moves from ``starts`` to ``ends`` [N, 3], metres, map frame.

    Surfaces are searched for up to ``max_distance_m``.
    """
    lengths = np.linalg.norm(ends - starts, axis=1)
    directions = (ends - starts) / np.maximum(lengths, 1e-12)[:, None]
    reach_m = max(max_distance_m, radius_m + view.voxel_m)
    step_m = REACH_VOXELS * view.voxel_m

    def to_surface(points: Doubles) -> Doubles:
        return distances(view, points, reach_m).distance_m.astype(np.float64)

    solid = _march(
        to_surface, starts, directions, lengths, radius_m=radius_m, step_m=step_m, clearance=True
    )
    # Unknown space is entered, not touched: a ball may touch it from outside.
    inside = np.nextafter(radius_m, 0.0) if radius_m > 0 else 0.0
    unknown = _march(
        lambda points: view.nearest_unknown(points, reach_m).distance,
        starts,
        directions,
        solid.contact,
        radius_m=inside,
        step_m=step_m,
        clearance=False,
    )
    return Segments(
        length_m=lengths.astype(np.float32),
        blocked=solid.blocked,
        contact_m=solid.contact.astype(np.float32),
        clearance_m=np.minimum(solid.clearance, max_distance_m).astype(np.float32),
        clearance_at_m=solid.clearance_at.astype(np.float32),
        meets_unknown=unknown.blocked,
        unknown_contact_m=np.where(unknown.blocked, unknown.contact, lengths).astype(np.float32),
        epoch=view.epoch,
    )


def _march(
    gap: Callable[[Doubles], Doubles],
    starts: Doubles,
    directions: Doubles,
    lengths: Doubles,
    radius_m: float,
    step_m: float,
    clearance: bool,
) -> _March:
    """Walk along the segments as far as the distance allows, until the first contact.

    ``gap`` gives the distances [N] at points [N, 3]. These change by no more than the way
    covered: the next contact is at least ``distance - radius`` away, and a place with less
    clearance ``distance - clearance``.
    """
    count = len(starts)
    march = _March(
        blocked=np.zeros(count, np.bool_),
        contact=lengths.copy(),
        clearance=np.full(count, np.inf),
        clearance_at=np.zeros(count),
    )
    at = np.zeros(count)
    going = np.arange(count)
    while len(going):
        place = at[going]
        distance = gap(starts[going] + place[:, None] * directions[going])
        less = distance < march.clearance[going]
        march.clearance[going[less]] = distance[less]
        march.clearance_at[going[less]] = place[less]
        touches = distance <= radius_m
        march.blocked[going[touches]] = True
        march.contact[going[touches]] = place[touches]
        step = distance - radius_m
        if clearance:
            step = np.minimum(step, distance - march.clearance[going] + step_m)
        # The end is checked, too.
        there = place >= lengths[going]
        at[going] = np.minimum(place + np.maximum(step, step_m), lengths[going])
        going = going[~touches & ~there]
    return march


@dataclass(frozen=True)
class Polyline:
    """The fields of :class:`Segments` for several one after the other; places are metres from the
    start of the first.
    """

    length_m: float
    blocked: bool
    contact_m: float
    clearance_m: float
    clearance_at_m: float
    meets_unknown: bool
    unknown_contact_m: float
    epoch: int

    def free(self, unknown: UnknownLike = Unknown.OBSTACLE) -> bool:
        """Return whether the ball can pass, where unknown space counts as asked.

        Raises:
            UnknownSpaceError: it counts as an error, and is met before any contact.
            ValueError: ``unknown`` is no :class:`Unknown`.
        """
        blocked, meets = np.array([self.blocked]), np.array([self.meets_unknown])
        return bool(are_free("polyline", blocked, meets, unknown)[0])


def along_polyline(parts: Segments) -> Polyline:
    """Return consecutive segments as one way."""
    lengths = parts.length_m.astype(np.float64)
    begins = np.cumsum(lengths) - lengths
    total = float(lengths.sum())
    # Nothing behind the first contact is reached.
    last = int(parts.blocked.argmax()) if parts.blocked.any() else len(lengths) - 1
    narrowest = int(parts.clearance_m[: last + 1].argmin())
    unknown = parts.meets_unknown[: last + 1]
    first_unknown = int(unknown.argmax())
    return Polyline(
        length_m=total,
        blocked=bool(parts.blocked[last]),
        contact_m=float(begins[last] + parts.contact_m[last]) if parts.blocked[last] else total,
        clearance_m=float(parts.clearance_m[narrowest]),
        clearance_at_m=float(begins[narrowest] + parts.clearance_at_m[narrowest]),
        meets_unknown=bool(unknown.any()),
        unknown_contact_m=float(begins[first_unknown] + parts.unknown_contact_m[first_unknown])
        if unknown.any()
        else total,
        epoch=parts.epoch,
    )
