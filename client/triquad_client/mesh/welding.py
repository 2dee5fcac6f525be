"""Joining the meshes of tiles: vertices on common faces become one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

WELD_M = 1e-4
"""Vertices closer than about this are one."""

_SHIFTS = np.array([(0.5, 0.5, 0.5), (0, 0.5, 0.5), (0.5, 0, 0.5), (0.5, 0.5, 0)])
"""Vertices that lie on a lattice edge may fall on two sides of a rounding boundary along it, and
along it only: a second round, shifted along that axis, brings them together."""


class Triangles(NamedTuple):
    """A surface in the map frame."""

    vertices: NDArray[np.float64]  # [V, 3] metres
    faces: NDArray[np.int32]  # [F, 3]


def joined(
    tiles: Sequence[Triangles],
    tile_side_m: float,
    minimum: NDArray[np.float64],
    maximum: NDArray[np.float64],
) -> Triangles:
    """One mesh of the tiles' faces whose centroids lie in the box between two corners [3]."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in tiles)])
    shifted = [faces + int(start) for (_, faces), start in zip(tiles, starts, strict=False)]
    vertices, faces = welded(
        np.concatenate([np.zeros((0, 3)), *(vertices for vertices, _ in tiles)]),
        np.concatenate([np.zeros((0, 3), np.int32), *shifted]).astype(np.int32),
        tile_side_m,
    )
    centroids = vertices[faces].mean(axis=1)
    inside = ((centroids >= minimum) & (centroids <= maximum)).all(axis=1)
    return compacted(vertices, faces[inside])


def welded(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    tile_side_m: float,
) -> Triangles:
    """The mesh with one vertex where tiles had several.

    Args:
        vertices: [V, 3], metres.
        faces: [F, 3].
        tile_side_m: side of the tiles; only vertices on their faces are looked at.

    Returns:
        The mesh without faces that welding made degenerate.
    """
    steps = vertices / tile_side_m
    border = (np.abs(steps - np.round(steps)) < WELD_M / tile_side_m).any(axis=1)
    shared = np.flatnonzero(border)
    target = np.arange(len(vertices))
    target[shared] = shared[_representatives(vertices[shared])]
    joined = target[faces]
    a, b, c = joined.T
    return compacted(vertices, joined[(a != b) & (b != c) & (c != a)])


def compacted(
    vertices: NDArray[np.float64],
    faces: NDArray[np.integer],
) -> Triangles:
    """The mesh without vertices that no face uses."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    number = np.cumsum(used) - 1
    return Triangles(vertices[used], number[faces].astype(np.int32).reshape(-1, 3))


def _representatives(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """For each point [N, 3], the index of the point that stands for it."""
    chosen = np.arange(len(points))
    for shift in _SHIFTS:
        cells = np.floor(points[chosen] / WELD_M + shift).astype(np.int64)
        _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        chosen = chosen[first[inverse.reshape(-1)]]
    return chosen
