"""Thinning of point clouds on a voxel grid."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

_MERGED_POINTS = 2_000_000  # fewer are not worth a merge


def thin(points: NDArray[np.float64], voxel_m: float) -> NDArray[np.float64]:
    """The first of the points ``[N, 3]`` in each voxel of side ``voxel_m``, in their order."""
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0)
    sizes = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    return points[np.sort(np.unique(keys, return_index=True)[1])]


def merged(clouds: Iterable[NDArray[np.float64]], voxel_m: float) -> NDArray[np.float64]:
    """All clouds as one ``[N, 3]``, one point per voxel of side ``voxel_m``."""
    held = [np.empty((0, 3))]  # the first is what is merged so far
    for cloud in clouds:
        held.append(thin(cloud, voxel_m))
        if sum(map(len, held[1:])) > max(len(held[0]), _MERGED_POINTS):
            held = [thin(np.concatenate(held), voxel_m)]
    return thin(np.concatenate(held), voxel_m)
