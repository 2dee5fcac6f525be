"""What searches for the nearest surface and the nearest unknown space found."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class NearestSurfels(NamedTuple):
    """The nearest surfels of N points of one region, in leaf coordinates; improved in place."""

    distances: NDArray[np.float64]  # [N] voxels; what lies farther than this is not looked for
    feet: NDArray[np.float64]  # [N, 3] the nearest point
    means: NDArray[np.float64]  # [N, 3] about the same, over all that is nearly as near
    rows: NDArray[np.int32]  # [N] number of the surfel, -1 where there is none

    def at(self, points: NDArray[np.intp]) -> "NearestSurfels":
        """What was found for some of the points [H]."""
        return NearestSurfels(
            self.distances[points], self.feet[points], self.means[points], self.rows[points]
        )


def no_surfels(limits: NDArray[np.float64]) -> NearestSurfels:
    """What points begin with, that look for surfels less than ``limits`` [N] voxels away."""
    count = len(limits)
    return NearestSurfels(
        limits.copy(), np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, -1, np.int32)
    )


@dataclass(frozen=True)
class NearestSurface:
    """The nearest seen surface of N points, map frame, metres.

    Where none was found within the limit, the distance is the limit and the rest is 0.
    """

    found: NDArray[np.bool_]  # [N]
    distance: NDArray[np.float64]  # [N] to the point
    point: NDArray[np.float64]  # [N, 3] the nearest point of it
    mean: NDArray[np.float64]  # [N, 3] about the same, over all that is nearly as near
    confidence: NDArray[np.float32]  # [N] in [0, 1]

    @classmethod
    def none(cls, count: int, max_distance_m: float) -> "NearestSurface":
        """What ``count`` points begin with, before anything is found; to be improved in place."""
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
        corner: NDArray[np.float64],
        voxel_m: float,
        confidence: NDArray[np.float32],
    ) -> None:
        """Note surfels [H] that are nearer to ``points`` [H], of the region at ``corner`` [3]."""
        self.found[points] = True
        self.distance[points] = surfels.distances * voxel_m
        self.point[points] = corner + surfels.feet * voxel_m
        self.mean[points] = corner + surfels.means * voxel_m
        self.confidence[points] = confidence


@dataclass(frozen=True)
class NearestUnknown:
    """The nearest unknown space of N points, map frame, metres.

    Where there is none within the limit, the distance is the limit and the point means nothing.
    """

    distance: NDArray[np.float64]  # [N] 0 in unknown space
    point: NDArray[np.float64]  # [N, 3] the nearest point of it
