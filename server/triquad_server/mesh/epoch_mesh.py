"""The mesh of an epoch, tile by tile."""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.region import BLOCK_VOXELS

from triquad_server.epochs.epoch import Epoch, FrozenRegion
from triquad_server.mesh.mesher import TileIndex, TileMesh, mesh_tile
from triquad_server.mesh.tile_lattice import TileLattice, tile_lattice, tiles_meeting
from triquad_server.settings import MeshSettings


class EpochMesh:
    """Makes the tiles of an epoch. Safe for any thread."""

    def __init__(self, epoch: Epoch, settings: MeshSettings) -> None:
        self._epoch = epoch
        self._settings = settings

    def tiles(
        self, minimum: NDArray[np.float64], maximum: NDArray[np.float64], level: int = 0
    ) -> NDArray[np.int32]:
        """Tiles [T, 3] of a level that hold seen surface and meet the box of two corners [3]."""
        lattice = tile_lattice(self._settings, level)
        tiles = {
            (x, y, z)
            for region in self._epoch.frozen_regions
            for x, y, z in self._surface_tiles(region, lattice).tolist()
        }
        indices = np.array(sorted(tiles), np.int32).reshape(-1, 3)
        low = indices * lattice.tile_side_m
        meets = ((low <= maximum) & (low + lattice.tile_side_m >= minimum)).all(axis=1)
        return np.asarray(indices[meets])

    def tile(self, index: TileIndex, level: int = 0) -> TileMesh:
        """The mesh of one tile; empty where no surface was seen."""
        return mesh_tile(self._epoch, index, tile_lattice(self._settings, level))

    def _surface_tiles(self, region: FrozenRegion, lattice: TileLattice) -> NDArray[np.int64]:
        """Tiles [T, 3] that meet a block with seen surface, or what is meshed around it."""
        settings = self._epoch.field_settings
        side = BLOCK_VOXELS * settings.leaf_m
        corner = region.centre - settings.region_side_m / 2
        low = region.evidence.surface_cells() * side + corner
        return tiles_meeting(low, low + side, lattice.reach_m, lattice)
