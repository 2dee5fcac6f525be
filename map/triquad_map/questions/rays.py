"""The ranges of rays: a simulated lidar, or what a localiser expects to see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats
from triquad_format.records.status import Status

from triquad_map.questions.answer import Answer
from triquad_map.questions.distance import distances
from triquad_map.view import REACH_VOXELS, MapView

_HIT_VOXELS = 0.025
"""A ray that comes as near to a surface meets it, in voxels; so short is the least step, too. From
there it is as far as the distance says that fell until then."""

_TOUCH_M = 1e-5
"""A ray that comes as near to unknown space has reached it: its places are no more exact."""

_LOOK_AHEAD_M = 3.0
"""The distance of a search for surface: farther costs more than shorter steps."""


@dataclass(frozen=True, repr=False)
class RayRanges(Answer):
    """The ranges of N rays, of one epoch.

    ``SURFACE``: to a seen surface. ``UNKNOWN``: to where unknown space begins. ``FREE``: to the
    largest range, through space that was seen to be free (or, where asked for, unknown).

    Attributes:
        range_m: [N] metres, along the ray.
        status: [N] :class:`Status`, as above.
    """

    _things: ClassVar[str] = "rays"
    range_m: Floats
    status: Bytes
    epoch: int


def rays(
    view: MapView,
    origins: Doubles,
    directions: Doubles,
    max_range_m: float,
    through_unknown: bool = False,
) -> RayRanges:
    """Return ranges of rays from ``origins`` [N, 3] along unit ``directions`` [N, 3], map frame.

    Unknown space stops them, unless they go ``through_unknown``.
    """
    status = np.full(len(origins), Status.FREE, np.uint8)
    ranges = np.full(len(origins), max_range_m)
    hit = trace(view, origins, directions, ranges=ranges)
    status[hit] = Status.SURFACE
    if not through_unknown:
        _stop_at_unknown(view, origins, directions, ranges=ranges, status=status)
    return RayRanges(ranges.astype(np.float32), status, view.epoch)


def trace(view: MapView, origins: Doubles, directions: Doubles, ranges: Doubles) -> Bools:
    """Shorten ``ranges`` [N] to the first surface (Hart 1996); return whether rays meet one."""
    hit = np.zeros(len(origins), np.bool_)
    at = np.zeros(len(origins))
    before = np.zeros(len(origins))  # distance at the last place
    step = np.zeros(len(origins))  # from there
    going = np.arange(len(origins))
    hit_m = _HIT_VOXELS * view.voxel_m
    reach_m = min(_LOOK_AHEAD_M, float(ranges.max(initial=hit_m)))
    while len(going):
        points = origins[going] + at[going, None] * directions[going]
        distance = distances(view, points, reach_m).distance_m.astype(np.float64)
        met = distance <= hit_m
        # The distance goes on to fall about as it did from the last place to this one.
        fall = np.maximum(before[going] - distance, 1e-9)
        rest = np.minimum(step[going] * distance / fall, REACH_VOXELS * view.voxel_m)
        hit[going[met]] = True
        ranges[going[met]] = np.clip((at[going] + rest)[met], 0.0, ranges[going[met]])
        before[going] = distance
        step[going] = np.maximum(distance, hit_m)
        at[going] += step[going]
        going = going[~met & (at[going] < ranges[going])]
    return hit


def _stop_at_unknown(
    view: MapView, origins: Doubles, directions: Doubles, ranges: Doubles, status: Bytes
) -> None:
    """Shorten the rays that enter unknown space."""
    step_m = REACH_VOXELS * view.voxel_m
    at = np.zeros(len(origins))
    going = np.arange(len(origins))
    while len(going):
        points = origins[going] + at[going, None] * directions[going]
        free_m = view.nearest_unknown(points, _LOOK_AHEAD_M).distance
        unknown = free_m <= _TOUCH_M
        ranges[going[unknown]] = at[going[unknown]]
        status[going[unknown]] = Status.UNKNOWN
        at[going] += np.maximum(free_m, step_m)
        going = going[~unknown & (at[going] < ranges[going])]
