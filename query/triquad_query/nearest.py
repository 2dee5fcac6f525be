"""What searches for the nearest surface and the nearest unknown space found."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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


@dataclass(frozen=True)
class NearestUnknown:
    """The nearest unknown space of N points, map frame, metres.

    Where there is none within the limit, the distance is the limit and the point means nothing.
    """

    distance: NDArray[np.float64]  # [N] 0 in unknown space
    point: NDArray[np.float64]  # [N, 3] the nearest point of it
