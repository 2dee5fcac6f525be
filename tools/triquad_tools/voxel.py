"""Thinning of point clouds on a voxel grid."""

import numpy as np
from numpy.typing import NDArray


def thin(points: NDArray[np.float64], voxel_m: float) -> NDArray[np.float64]:
    """The first of the points ``[N, 3]`` in each voxel of side ``voxel_m``, in their order."""
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0)
    sizes = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    return points[np.sort(np.unique(keys, return_index=True)[1])]
