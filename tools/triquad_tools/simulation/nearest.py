"""The nearest of many solids: a grid whose cells list the few that can be it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_map.compiled.kernel import kernel

from triquad_tools.simulation.solids import distance_to

CELL_M = 2.5


@dataclass(frozen=True)
class CandidateGrid:
    """Per cube of a grid, the solids that are nearest to some point of that cube.

    The last list, for points beside the grid, names all solids.
    """

    origin: NDArray[np.float64]  # [3] metres, lower corner
    shape: NDArray[np.int64]  # [3] cells
    starts: NDArray[np.int64]  # [cells + 2] into members
    members: NDArray[np.int64]  # rows of the table of solids


def candidate_grid(solids: NDArray[np.float64], bounds: NDArray[np.float64]) -> CandidateGrid:
    """The grid over ``bounds [2, 3]`` for a table of solids ``[S, 11]``."""
    shape = np.ceil((bounds[1] - bounds[0]) / CELL_M).astype(np.int64)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    centres = bounds[0] + (cells.reshape(-1, 3) + 0.5) * CELL_M
    distances = _all_distances(solids, centres)
    # A distance changes by at most half a diagonal between a cell's centre and its corners.
    reach = distances.min(axis=1, keepdims=True) + np.sqrt(3.0) * CELL_M
    candidates = np.vstack([distances <= reach, np.ones(len(solids), np.bool_)])
    return CandidateGrid(
        origin=np.ascontiguousarray(bounds[0], np.float64),
        shape=shape,
        starts=np.concatenate([[0], np.cumsum(candidates.sum(axis=1))]),
        members=np.nonzero(candidates)[1],
    )


@dataclass(frozen=True)
class Nearest:
    """The nearest solid of each of N points."""

    distances: NDArray[np.float64]  # [N] signed, metres
    gradients: NDArray[np.float64]  # [N, 3] of the distance, world frame
    owners: NDArray[np.int64]  # [N] rows of the table of solids


def nearest(
    solids: NDArray[np.float64], grid: CandidateGrid, points: NDArray[np.float64]
) -> Nearest:
    """The solids of least signed distance to points ``[N, 3]`` of the world, metres."""
    lists = (grid.origin, grid.shape, grid.starts, grid.members)
    return Nearest(*_nearest(solids, *lists, points))


@kernel()
def _all_distances(solids: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    distances = np.empty((points.shape[0], solids.shape[0]))
    for i in range(points.shape[0]):
        for s in range(solids.shape[0]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            distances[i, s] = distance_to(solids[s], x, y, z)[0]
    return distances


@kernel()
def _cell(origin: NDArray[np.float64], shape: NDArray[np.int64], point: NDArray[np.float64]) -> int:
    """The flat index of a point's cell; one past the last for a point beside the grid."""
    flat = np.int64(0)
    for axis in range(3):
        cell = np.floor((point[axis] - origin[axis]) / CELL_M)
        if not 0 <= cell < shape[axis]:
            return int(shape[0] * shape[1] * shape[2])
        flat = flat * shape[axis] + int(cell)
    return int(flat)


@kernel()
def _nearest(
    solids: NDArray[np.float64],
    origin: NDArray[np.float64],
    shape: NDArray[np.int64],
    starts: NDArray[np.int64],
    members: NDArray[np.int64],
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    count = points.shape[0]
    distances = np.full(count, np.inf)
    gradients = np.zeros((count, 3))
    owners = np.full(count, -1, np.int64)
    for i in range(count):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cell = _cell(origin, shape, points[i])
        for k in range(starts[cell], starts[cell + 1]):
            row = solids[members[k]]
            distance, gx, gy, gz = distance_to(row, x, y, z)
            if distance < distances[i]:
                distances[i] = distance
                gradients[i, 0], gradients[i, 1], gradients[i, 2] = gx, gy, gz
                owners[i] = members[k]
    return distances, gradients, owners
