"""The lattices of mesh tiles: one for each level of detail."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_server.settings import MeshSettings

_GROUP_CELLS = 8


@dataclass(frozen=True)
class TileLattice:
    """Where the cells and tiles of one level lie: at multiples of their sides."""

    level: int
    cell_m: float
    cells: int  # along the side of a tile, the same on all levels
    reach_m: float  # centres of faces lie at most this far from voxels with seen surface
    group: int  # cells along the side of the groups that are searched first

    @property
    def tile_side_m(self) -> float:
        """Side of a tile."""
        return self.cell_m * self.cells

    @property
    def margin_m(self) -> float:
        """A change so far from a tile, or farther, does not concern it."""
        return self.cell_m + self.reach_m


def tile_lattice(settings: MeshSettings, level: int) -> TileLattice:
    """The lattice of a level, ``0 <= level < LEVELS``.

    A tile of level ``l`` covers ``2**l`` tiles of level 0 along each axis. Groups of cells are of
    the same size on all levels, so that no level searches farther around than level 0.
    """
    scale = 1 << level
    return TileLattice(
        level,
        settings.cell_m * scale,
        settings.tile_cells,
        settings.reach_m * scale,
        _GROUP_CELLS // scale,
    )


def tiles_meeting(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    margin_m: float,
    lattice: TileLattice,
) -> NDArray[np.int64]:
    """Tiles [T, 3], each once, that come within ``margin_m`` of any of N boxes.

    ``low`` and ``high`` [N, 3] are the boxes' corners, metres, map frame.
    """
    first = np.floor((low - margin_m) / lattice.tile_side_m).astype(np.int64)
    last = np.floor((high + margin_m) / lattice.tile_side_m).astype(np.int64)
    tiles = [np.zeros((0, 3), np.int64)]
    for offset in np.ndindex(*((last - first).max(axis=0, initial=0) + 1)):
        tile = first + offset
        tiles.append(tile[(tile <= last).all(axis=1)])
    return _each_once(np.concatenate(tiles))


def _each_once(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different ones of cells [N, 3], in order."""
    if len(cells) == 0:
        return cells
    low = cells.min(axis=0)
    x, y, z = (int(size) for size in cells.max(axis=0) - low + 1)
    if x * y * z >= 2**62:
        return np.asarray(np.unique(cells, axis=0))
    # By one number each: numpy holds Python's lock while it sorts rows.
    names = np.unique(((cells - low) * (y * z, z, 1)).sum(axis=1))
    each = np.stack([names // (y * z), names // z % y, names % z], axis=1) + low
    return np.asarray(each, np.int64)
