"""The interface of every map, live or from a file; all questions are put together from this."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats

PartT = TypeVar("PartT")


class NotAskedError(TriquadError, AttributeError):
    """A part of an answer that was not asked for."""


def asked(name: str, part: PartT | None, argument: str) -> PartT:
    """Return the part called ``name``, so that who asked for it need not prove that it is there.

    Raises:
        NotAskedError: it is ``None``, as the query's ``argument`` was left out.
    """
    if part is None:
        raise NotAskedError(f"{name} was not asked for: give the query {argument}=True")
    return part


REACH_VOXELS = 0.5
"""The reach of a surface beyond the voxels in which rays ended, in voxels: it may cut the corner of
one in which none happened to end. What lies within it of a surface belongs to it."""

NO_LENGTH_M = 1e-6
"""A vector of no more than this length has no direction."""


@dataclass(frozen=True)
class FieldAnswer:
    """The field and the status of N points."""

    sdf: Floats  # [N] metres, positive in free space; NaN where no region is
    status: Bytes  # [N] triquad_format.records.status.Status
    _gradient: Floats | None

    @property
    def gradient(self) -> Floats:
        """[N, 3] d(sdf)/dx, map frame; NaN as the sdf. :class:`NotAskedError`: not asked for."""
        return asked("gradient", self._gradient, "gradient")


class NearestSurface(NamedTuple):
    """The nearest seen surface of N points, map frame, metres.

    Where none was found within the limit, the distance is the limit and the rest is 0.
    """

    found: Bools  # [N]
    distance: Doubles  # [N] to the point
    point: Doubles  # [N, 3] the nearest point of it
    gradient: Doubles  # [N, 3] of the distance: unit vectors from all that is nearly as near
    confidence: Floats  # [N] in [0, 1]
    learnt: Bools  # [N] whether the field shows it; else rays alone do
    normal: Floats  # [N, 3] of what is not learnt, unit vectors to free space; else 0


@dataclass(frozen=True)
class NearestUnknown:
    """The nearest unknown space of N points, map frame, metres.

    Where there is none within the limit, the distance is the limit and the point means nothing.
    """

    distance: Doubles  # [N] 0 in unknown space
    point: Doubles  # [N, 3] the nearest point of it


class MapView(Protocol):
    """A map that does not change. Points are [N, 3], metres, map frame, finite."""

    @property
    def epoch(self) -> int:
        """Number of the published state of the map that answers."""

    @property
    def voxel_m(self) -> float:
        """Side of the voxels in which rays ended."""

    def query(self, points: Doubles, gradient: bool = False) -> FieldAnswer:
        """Return the trained field and the status at points."""

    def status(self, points: Doubles, reach_m: float | None = None) -> Bytes:
        """Return status values [N] of points.

        ``SURFACE`` reaches ``reach_m`` beyond the voxels in which rays ended; half a voxel if
        not given.
        """

    def nearest_surface(self, points: Doubles, max_distance_m: float) -> NearestSurface:
        """Return the nearest seen surface, searched for as far as ``max_distance_m``."""

    def nearest_unknown(self, points: Doubles, max_distance_m: float) -> NearestUnknown:
        """Return the nearest unknown space, searched for as far as ``max_distance_m``."""
