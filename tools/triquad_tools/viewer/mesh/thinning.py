"""Meshes with fewer triangles, for what is far away."""

import numpy as np

from triquad_tools.viewer.page.unlit_glb import Triangles

_ON_SIDE_M = 2e-5  # more than rounding, less than what noise moves a ground that lies in the side


def thinned(triangles: Triangles, cell_m: float, side_m: float) -> Triangles:
    """The mesh of a tile with one vertex for each cell (Rossignac and Borrel 1993).

    That is the mean of the vertices in the cell; those on the tile's sides have cells of their own,
    so that tiles that are thinned alike meet as before.

    Args:
        triangles: the mesh.
        cell_m: side of the cells, of which a whole number makes up the tile.
        side_m: side of the tile.
    """
    vertices, faces = triangles
    on_side = np.abs(vertices - np.round(vertices / side_m) * side_m) < _ON_SIDE_M
    places = vertices / cell_m
    cells = np.where(on_side, 2 * np.round(places), 2 * np.floor(places) + 1).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    counts = cells.max(axis=0, initial=0) + 1
    names = (cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2]
    _, owners, members = np.unique(names, return_inverse=True, return_counts=True)
    merged = np.stack(
        [np.bincount(owners, vertices[:, axis], len(members)) for axis in range(3)], axis=1
    )
    a, b, c = owners.reshape(-1)[faces].T
    kept = (a != b) & (b != c) & (c != a)
    rows = np.stack([a, b, c], axis=1)[kept].astype(np.int32)
    return Triangles((merged / members[:, None]).astype(np.float32), rows)
