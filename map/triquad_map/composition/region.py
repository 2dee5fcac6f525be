"""What one region of a map can do. The composition is put together from this alone."""

from dataclasses import dataclass
from typing import Protocol

from triquad_format.records.arrays import Bytes, Doubles, Floats, Longs
from triquad_format.records.region import RegionIndex

from triquad_map.nearest import NearestSurfels


@dataclass(frozen=True)
class FieldValues:
    """Signed distances [N] and, where asked for, their gradients [N, 3] (else [0, 3])."""

    sdf: Floats
    gradient: Floats


class FieldEngine(Protocol):
    """What computes the field of one region."""

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre."""


class SeenStatus(Protocol):
    """What tells the status of a region's points."""

    def status(self, voxels: Doubles, reach: float) -> Bytes:
        """Status values [N] at leaf coordinates [N, 3].

        ``SURFACE`` reaches ``reach`` voxels beyond those in which rays ended.
        """


class SeenSpace(SeenStatus, Protocol):
    """What rays have shown of a region."""

    @property
    def newest_s(self) -> int:
        """When a ray last ended anywhere, seconds since 1970; 0: never, or not known."""

    def find_unknown(
        self, voxels: Doubles, blocks: range, distances: Doubles, nearest: Doubles
    ) -> None:
        """Lower ``distances`` [N] to those from ``voxels`` [N, 3] to the nearest unknown voxel.

        Points are leaf coordinates, as are the ``nearest`` [N, 3] of unknown space; distances are
        in voxels. Only blocks whose indices are in ``blocks`` on each axis are searched.
        """


class RegionSurfels(Protocol):
    """The surfels of a region: S of them."""

    @property
    def confidence(self) -> Floats:
        """[S] in [0, 1], as if just seen."""

    @property
    def seen_s(self) -> Longs:
        """[S] when each was seen last, seconds since 1970."""

    def __len__(self) -> int: ...

    def find_nearest(self, points: Doubles, found: NearestSurfels) -> None:
        """Improve ``found`` where a surfel lies nearer to leaf coordinates ``points`` [N, 3]."""


class FieldRegion(Protocol):
    """A region of which field and status are known."""

    @property
    def index(self) -> RegionIndex:
        """Which region."""

    @property
    def centre(self) -> Doubles:
        """[3] metres, map frame."""

    @property
    def engine(self) -> FieldEngine:
        """What computes its field."""

    @property
    def evidence(self) -> SeenStatus:
        """What rays have shown of it."""


class MapRegion(FieldRegion, Protocol):
    """A region of which all is known; surfels may be made when they are asked for."""

    @property
    def evidence(self) -> SeenSpace:
        """What rays have shown of it."""

    @property
    def surfels(self) -> RegionSurfels:
        """What stands for its surface. Not to be asked for within a :class:`Split`."""
