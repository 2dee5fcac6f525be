"""Which mesh tiles truly changed, told by their triangles alone."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from triquad_client import Mesh
from triquad_server.mesh.tile_lattice import TileIndex

_CANDIDATES = 8  # triangles that are tried for each point: those of the nearest centroids


def changed_tiles(
    before: Mapping[TileIndex, Mesh],
    after: Mapping[TileIndex, Mesh],
    tolerance_m: float,
    cell_m: float,
) -> set[TileIndex]:
    """Tiles whose surface came, went or moved.

    That is where a vertex is farther than ``cell_m`` from all triangles of the other time, or more
    than half of them are farther than ``tolerance_m``. Triangles have to be about as large as
    cells. Vertices are in the map frame: those of neighbouring tiles count as well, so that nothing
    comes or goes where a surface crosses from one tile to the next.
    """
    old, new = _Triangles(before), _Triangles(after)
    return {
        index
        for index in before.keys() | after.keys()
        if (index in before and _left(before[index].vertices, new, tolerance_m, cell_m))
        or (index in after and _left(after[index].vertices, old, tolerance_m, cell_m))
    }


def _left(
    points: NDArray[np.floating], triangles: "_Triangles", tolerance_m: float, cell_m: float
) -> bool:
    moved = points[triangles.farther(points, tolerance_m)]
    return 2 * len(moved) > len(points) or bool(triangles.farther(moved, cell_m).any())


class _Triangles:
    """The triangles of all tiles."""

    def __init__(self, tiles: Mapping[TileIndex, Mesh]) -> None:
        corners = [mesh.vertices[mesh.faces] for mesh in tiles.values()]
        self._corners = np.concatenate([np.zeros((0, 3, 3)), *corners])  # [F, 3, 3]
        self._tree = cKDTree(self._corners.mean(axis=1))

    def farther(self, points: NDArray[np.floating], limit_m: float) -> NDArray[np.bool_]:
        """Whether points [N, 3] are farther from the triangles."""
        from trimesh.triangles import closest_point  # slow to import

        far = np.ones(len(points), np.bool_)
        count = min(_CANDIDATES, len(self._corners))
        if count == 0 or len(points) == 0:
            return far
        _, candidates = self._tree.query(points, range(1, count + 1), workers=-1)
        for rows in candidates.T:
            left = np.flatnonzero(far)
            corners = self._corners[rows[left]]
            nearest = closest_point(corners, points[left])
            far[left] = np.linalg.norm(nearest - points[left], axis=1) > limit_m
        return far
