"""Meshes with fewer triangles, for what is far away."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Floats, Ints


class Triangles(NamedTuple):
    """A mesh within a tile."""

    vertices: Floats  # [V, 3] metres, relative to the tile's origin
    faces: Ints  # [F, 3]


def thinned(vertices: NDArray[np.float32], faces: NDArray[np.int32], cell_m: float) -> Triangles:
    """The mesh with one vertex for each cell: the mean of those in it (Rossignac and Borrel 1993).

    Args:
        vertices: [V, 3] metres.
        faces: [F, 3] rows of vertices.
        cell_m: side of the cells.
    """
    cells = np.floor(vertices / cell_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    sides = cells.max(axis=0, initial=0) + 1
    names = (cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]
    _, owners, counts = np.unique(names, return_inverse=True, return_counts=True)
    merged = np.stack(
        [np.bincount(owners, vertices[:, axis], len(counts)) for axis in range(3)], axis=1
    )
    a, b, c = owners.reshape(-1)[faces].T
    kept = (a != b) & (b != c) & (c != a)
    rows = np.stack([a, b, c], axis=1)[kept].astype(np.int32)
    return Triangles((merged / counts[:, None]).astype(np.float32), rows)
