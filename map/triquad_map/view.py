"""What every map answers, live or from a file; all questions are put together from this."""

from dataclasses import dataclass
from typing import Protocol

from triquad_format.records.arrays import Bytes, Doubles, Floats

from triquad_map.nearest import NearestSurface, NearestUnknown


@dataclass(frozen=True)
class FieldAnswer:
    """What the map says of N points."""

    sdf: Floats  # [N] metres, positive in free space; NaN where no region is
    status: Bytes  # [N] triquad_format.records.status.Status
    gradient: Floats | None  # [N, 3] d(sdf)/dx, map frame; NaN as the sdf


class MapView(Protocol):
    """A map that does not change. Points are [N, 3], metres, map frame, finite."""

    @property
    def epoch(self) -> int:
        """Number of the published state of the map that answers."""

    @property
    def voxel_m(self) -> float:
        """Side of the voxels in which rays ended."""

    def query(self, points: Doubles, gradient: bool = False) -> FieldAnswer:
        """The trained field and the status at points."""

    def status(self, points: Doubles) -> Bytes:
        """Status values [N] of points."""

    def nearest_surface(self, points: Doubles, max_distance_m: float) -> NearestSurface:
        """The nearest seen surface, searched for as far as ``max_distance_m``."""

    def nearest_unknown(self, points: Doubles, max_distance_m: float) -> NearestUnknown:
        """The nearest unknown space, searched for as far as ``max_distance_m``."""
