"""The status of spheres: a robot's body, made of spheres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles
from triquad_format.records.status import Status

from triquad_map.questions.answer import Answer
from triquad_map.questions.distance import (
    Unknown,
    UnknownLike,
    are_free,
    distances,
)
from triquad_map.view import MapView


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
