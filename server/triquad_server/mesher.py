"""Meshes of tiles: marching cubes on a fixed lattice of the map frame.

Lattice points are multiples of ``cell_m``, whatever the tile, so neighbouring tiles share the
points of their common face and meet without seams. Cells are meshed only where the evidence saw a
surface.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes
from triquad_format.status import Status

from triquad_server.settings import MeshSettings

_GROUP = 8  # cells along the side of the groups that are looked at first


@dataclass(frozen=True)
class TileMesh:
    """Triangles of one tile."""

    origin: NDArray[np.float64]  # [3] metres, map frame: the tile's minimum corner
    vertices: NDArray[np.float32]  # [V, 3] metres, relative to the origin
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space
    changed: int  # epoch in which the tile last changed


class Distances(Protocol):
    """What the mesher asks of an epoch."""

    def query(self, points: NDArray[np.float64], gradient: bool) -> "Values":
        """Signed distances at points [N, 3]."""

    def status(self, points: NDArray[np.float64], reach_m: float) -> NDArray[np.uint8]:
        """Status values [N] at points [N, 3]."""

    def changed(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> int:
        """Epoch of the last change between two corners [3]."""


class Values(Protocol):
    """What the mesher needs of an answer."""

    @property
    def sdf(self) -> NDArray[np.float32]:
        """Signed distances [N], metres."""


def mesh_tile(source: Distances, tile: tuple[int, int, int], settings: MeshSettings) -> TileMesh:
    """The surface within one tile.

    Args:
        source: the map.
        tile: indices of the tile, which covers ``[tile, tile + 1) * tile_side_m``.
        settings: the lattice.
    """
    cells = settings.tile_cells
    first = np.asarray(tile, np.int64) * cells
    origin = (first * settings.cell_m).astype(np.float64)
    version = source.changed(origin, origin + settings.tile_side_m)
    seen = _seen_cells(source, first, settings)
    if len(seen) == 0:
        return _empty(origin, version)
    volume = _lattice_values(source, seen, first, settings)
    # The mask of skimage belongs to the upper corner of a cell.
    mask = np.zeros(volume.shape, bool)
    mask[tuple((seen + 1).T)] = True
    mask &= ~_no_crossing(volume, mask)
    if not mask.any():
        return _empty(origin, version)
    # Face order: the distance falls towards the solid.
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        volume,
        0.0,
        mask=mask,
        gradient_direction="descent",
    )
    return TileMesh(
        origin,
        (vertices * settings.cell_m).astype(np.float32),
        np.ascontiguousarray(faces.astype(np.int32)),
        version,
    )


def _seen_cells(
    source: Distances,
    first: NDArray[np.int64],
    settings: MeshSettings,
) -> NDArray[np.int64]:
    """Cells [C, 3] of the tile at whose centres a surface was seen."""
    groups = _grid(-(-settings.tile_cells // _GROUP)) * _GROUP
    centres = ((first + groups + _GROUP / 2) * settings.cell_m).astype(np.float64)
    # A group is looked into where a surface may be seen at the centre of any of its cells.
    wide = settings.cell_m * _GROUP / 2 + settings.reach_m
    groups = groups[source.status(centres, wide) == Status.SURFACE]
    cells = (groups[:, None] + _grid(_GROUP)).reshape(-1, 3)
    cells = cells[(cells < settings.tile_cells).all(axis=1)]
    centres = ((first + cells + 0.5) * settings.cell_m).astype(np.float64)
    seen = source.status(centres, settings.reach_m)
    return np.asarray(cells[seen == Status.SURFACE])


def _grid(side: int) -> NDArray[np.int64]:
    """Cells [side**3, 3] of a cube."""
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)


def _lattice_values(
    source: Distances,
    seen: NDArray[np.int64],
    first: NDArray[np.int64],
    settings: MeshSettings,
) -> NDArray[np.float32]:
    """Distances on the tile's lattice points [cells + 1] * 3; far ones, at no seen cell, are 1."""
    shape = (settings.tile_cells + 1,) * 3
    needed = np.zeros(shape, bool)
    for corner in np.ndindex(2, 2, 2):
        needed[tuple((seen + corner).T)] = True
    points = np.argwhere(needed)
    volume = np.ones(shape, np.float32)
    lattice = ((first + points) * settings.cell_m).astype(np.float64)
    volume[needed] = source.query(lattice, False).sdf
    return volume


def _no_crossing(volume: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (named by their upper corner) whose corners all lie on one side, or are unknown."""
    low = np.full(volume.shape, np.inf, np.float32)
    high = np.full(volume.shape, -np.inf, np.float32)
    inner = (slice(1, None),) * 3
    for corner in np.ndindex(2, 2, 2):
        part = volume[tuple(slice(1 - c, s - c) for c, s in zip(corner, volume.shape, strict=True))]
        low[inner] = np.minimum(low[inner], part)
        high[inner] = np.maximum(high[inner], part)
    return mask & ~((low <= 0) & (high >= 0))


def _empty(origin: NDArray[np.float64], version: int) -> TileMesh:
    return TileMesh(origin, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), version)
