"""How far a sensor sees."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def reach_m(clouds: Sequence[NDArray[np.floating]]) -> float:
    """Return within how many metres of the sensor 95 % of the points of clouds [N, 3] are.

    In simulated rooms that is 2 to 5 m, on streets with 16 to 128 beams 20 to 66. What lies on a
    table is not told from a room, which is seen behind it, nor a fast road from a street. Of no
    points it is infinite.
    """
    ranges = np.concatenate([np.linalg.norm(points, axis=1) for points in clouds])
    ranges = ranges[np.isfinite(ranges)]
    return float(np.quantile(ranges, 0.95)) if len(ranges) else math.inf
