"""What searches for the nearest surface and the nearest unknown space found."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints


class NearestSurfels(NamedTuple):
    """The nearest surfels of N points of one region, in leaf coordinates; improved in place."""

    distances: Doubles  # [N] voxels; what lies farther than this is not searched for
    closest: Doubles  # [N, 3] their points that are nearest
    means: Doubles  # [N, 3] about the same, over all that is nearly as near
    rows: Ints  # [N] number of the surfel, -1 where there is none

    def at(self, points: NDArray[np.intp]) -> "NearestSurfels":
        """What was found for some of the points [H]."""
        return NearestSurfels(
            self.distances[points], self.closest[points], self.means[points], self.rows[points]
        )


def no_surfels(limits: Doubles) -> NearestSurfels:
    """What is known of points before surfels less than ``limits`` [N] voxels away are found."""
    count = len(limits)
    return NearestSurfels(
        limits.copy(), np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, -1, np.int32)
    )


@dataclass(frozen=True)
class NearestSurface:
    """The nearest seen surface of N points, map frame, metres.

    Where none was found within the limit, the distance is the limit and the rest is 0.
    """

    found: Bools  # [N]
    distance: Doubles  # [N] to the point
    point: Doubles  # [N, 3] the nearest point of it
    mean: Doubles  # [N, 3] about the same, over all that is nearly as near
    confidence: Floats  # [N] in [0, 1]

    @classmethod
    def none(cls, count: int, max_distance_m: float) -> "NearestSurface":
        """What is known of ``count`` points before the search; to be improved in place."""
        return cls(
            np.zeros(count, np.bool_),
            np.full(count, max_distance_m),
            np.zeros((count, 3)),
            np.zeros((count, 3)),
            np.zeros(count, np.float32),
        )

    def take(
        self,
        points: NDArray[np.intp],
        surfels: NearestSurfels,
        corner: Doubles,
        voxel_m: float,
        confidence: Floats,
    ) -> None:
        """Take surfels [H] that are nearer to ``points`` [H], of the region at ``corner`` [3]."""
        self.found[points] = True
        self.distance[points] = surfels.distances * voxel_m
        self.point[points] = corner + surfels.closest * voxel_m
        self.mean[points] = corner + surfels.means * voxel_m
        self.confidence[points] = confidence


@dataclass(frozen=True)
class NearestUnknown:
    """The nearest unknown space of N points, map frame, metres.

    Where there is none within the limit, the distance is the limit and the point means nothing.
    """

    distance: Doubles  # [N] 0 in unknown space
    point: Doubles  # [N, 3] the nearest point of it
