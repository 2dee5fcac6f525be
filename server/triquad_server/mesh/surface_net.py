"""The surface of a region on a lattice of cells, one vertex in each cell that it crosses.

The method is surface nets (Gibson 1998). It is plain numpy, as map files are written without
compiled code, too.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Region, seen_voxels

NET_LEAVES = 2
"""Side of the cells, in leaves: 0.4 m."""

_REACH_LEAVES = 0.4
"""Middles of faces lie at most so far from voxels with seen surface, as in the coarsest tiles."""

_CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_EDGES = [(corner, corner | bit) for corner in range(8) for bit in (1, 2, 4) if not corner & bit]
"""The two corners of each edge, as rows of ``_CORNERS``."""

_DIAGONALS = 2 * _CORNERS - 1

Distances = Callable[[Doubles], NDArray[np.floating]]
"""Signed distances [N] at points [N, 3] of the map frame."""


@dataclass(frozen=True)
class SurfaceNet:
    """Quadrilaterals between the vertices of cells that the surface crosses."""

    cells: Longs  # [V, 3] the cell of each vertex
    points: Doubles  # [V, 3] vertices, in cells from the region's corner
    quads: NDArray[np.intp]  # [Q, 4] rows of vertices, counter-clockwise seen from free space

    @property
    def rim(self) -> Bools:
        """Which vertices [V] lie on an edge that belongs to one face alone."""
        count = len(self.points)
        ends = np.sort(np.stack([self.quads, np.roll(self.quads, -1, axis=1)], axis=2), axis=2)
        edges = ends.reshape(-1, 2) @ (count, 1)
        edges, faces = np.unique(edges, return_counts=True)
        single = edges[faces == 1]
        rim = np.zeros(count, np.bool_)
        rim[single // max(count, 1)] = True
        rim[single % max(count, 1)] = True
        return rim

    def of_faces(self, kept: Bools) -> "SurfaceNet":
        """The net with some of its faces [Q], and the vertices that they use."""
        used, quads = np.unique(self.quads[kept], return_inverse=True)
        return SurfaceNet(self.cells[used], self.points[used], quads=quads.reshape(-1, 4))


def surface_net(region: Region, settings: FieldSettings, distances: Distances) -> SurfaceNet:
    """The surface of a region where rays have seen it."""
    voxels = seen_voxels(region.evidence, region.evidence.surface)
    cells = morton.decode(_cells_around(voxels, (1 << settings.depth) - 1), 3)
    # By codes: numpy holds Python's lock while it sorts rows.
    corners = morton.encode(cells[:, None] + _CORNERS)  # [C, 8]
    codes, where = np.unique(corners, return_inverse=True)
    side_m, origin = settings.leaf_m * NET_LEAVES, settings.region_corner(region.index)
    found = np.asarray(distances(morton.decode(codes, 3) * side_m + origin), np.float64)
    values = found[where.reshape(corners.shape)]
    known = np.isfinite(values).all(axis=1)  # not so where a cell reaches out of all regions
    cells, values = cells[known], values[known]
    crossed, points = _crossings(cells, values)
    quads = _quads(cells[crossed], values[crossed])
    net = SurfaceNet(cells[crossed], points, quads=quads)
    return net.of_faces(_near(net.points[net.quads].mean(axis=1) * NET_LEAVES, voxels))


def _cells_around(voxels: Longs, last: int) -> Longs:
    """Codes [C] of the cells that come within a leaf of any of the voxels [N, 3], 0 to ``last``.

    The surface is where the field says, which may be in the cell beside the voxel that was hit.
    """
    around = (np.clip(voxels + step, 0, last) // NET_LEAVES for step in _DIAGONALS)
    return np.unique(np.concatenate([np.unique(morton.encode(cells)) for cells in around]))


def _near(points: Doubles, voxels: Longs) -> Bools:
    """Which points [P, 3], in leaves, are within reach of any of the voxels [N, 3]."""
    seen = np.sort(morton.encode(voxels))
    near = np.zeros(len(points), np.bool_)
    for step in _DIAGONALS:
        reached = np.floor(points + _REACH_LEAVES * step).astype(np.int64)
        codes = morton.encode(np.maximum(reached, 0))
        rows = np.minimum(np.searchsorted(seen, codes), len(seen) - 1)
        near |= seen[rows] == codes
    return near


def _crossings(cells: Longs, values: Doubles) -> tuple[NDArray[np.intp], Doubles]:
    """Cells that the surface crosses, and the mean [K, 3] of where it crosses their edges."""
    total = np.zeros((len(cells), 3))
    count = np.zeros(len(cells))
    for a, b in _EDGES:
        low, high = values[:, a], values[:, b]
        rows = np.flatnonzero((low > 0) != (high > 0))
        share = (low[rows] / (low[rows] - high[rows]))[:, None]
        total[rows] += cells[rows] + _CORNERS[a] + share * (_CORNERS[b] - _CORNERS[a])
        count[rows] += 1
    crossed = np.flatnonzero(count)
    return crossed, total[crossed] / count[crossed, None]


def _quads(cells: Longs, values: Doubles) -> NDArray[np.intp]:
    """The four cells around each crossed edge, counter-clockwise seen from free space."""
    codes = morton.encode(cells)
    order = np.argsort(codes)
    quads = [np.zeros((0, 4), np.intp)]
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        inside = values[:, 0] > 0, values[:, 4 >> axis] > 0
        rows = np.flatnonzero((inside[0] != inside[1]) & (cells.min(axis=1) > 0))
        around = np.stack([cells[rows], cells[rows] - u, cells[rows] - u - v, cells[rows] - v], 1)
        wanted = morton.encode(around)
        found = np.minimum(np.searchsorted(codes[order], wanted), max(len(codes) - 1, 0))
        there = (codes[order][found] == wanted).all(axis=1)
        quad = order[found][there]
        backwards = inside[0][rows][there]
        quads.append(np.where(backwards[:, None], quad[:, ::-1], quad))
    return np.concatenate(quads)
