"""What every map answers, live or from a file; all questions are put together from this."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from triquad_map.nearest import NearestSurface, NearestUnknown
from triquad_map.reference.evaluator import Answer


class MapView(Protocol):
    """A map that does not change. Points are [N, 3], metres, map frame, finite."""

    @property
    def number(self) -> int:
        """Number of its epoch."""

    @property
    def voxel_m(self) -> float:
        """Side of the voxels in which rays ended."""

    def query(self, points: NDArray[np.float64], gradient: bool = False) -> Answer:
        """The trained field and the status at points."""

    def status(self, points: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Status values [N] of points."""

    def nearest_surface(self, points: NDArray[np.float64], max_distance_m: float) -> NearestSurface:
        """The nearest seen surface, looked for as far as ``max_distance_m``."""

    def nearest_unknown(self, points: NDArray[np.float64], max_distance_m: float) -> NearestUnknown:
        """The nearest unknown space, looked for as far as ``max_distance_m``."""
