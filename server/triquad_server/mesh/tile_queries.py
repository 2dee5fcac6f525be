"""Answers to queries of single mesh tiles, and of which there are."""

from dataclasses import replace

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Ints
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.wire.messages import Tile, TileList, TileListRequest, TileRequest
from triquad_map.composition.composed_view import ComposedView

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.mesh.holes import check_fill
from triquad_server.mesh.mesher import TileLattice, check_box, check_level, mesh_tile
from triquad_server.mesh.tile_cache import TileCache

MAX_TILES = 1_000_000
"""Tiles of one list."""

TILE_INDEX_LIMIT = 1_000_000
"""Tile indices lie in ``[-TILE_INDEX_LIMIT, TILE_INDEX_LIMIT]``."""


class TileQueries:
    """Answers mesh queries."""

    def __init__(self, epochs: EpochHistory, cache: TileCache) -> None:
        """``cache`` knows when tiles changed."""
        self._epochs = epochs
        self._cache = cache

    def tiles(self, request: TileListRequest) -> TileList:
        """The tiles that meet the request's box.

        Raises:
            RefusedError: a field is out of range, the epoch is gone, or the tiles are too many.
        """
        check_box(request.minimum, request.maximum)
        check_level(request.level)
        check_fill(request.fill_m)
        epoch = self._epochs.get(request.epoch)
        lattice = self._cache.lattice(request.level)
        tiles = surface_tiles(epoch, lattice, request.fill_m)
        tiles = tiles[lattice.meets(tiles, request.minimum, request.maximum)]
        if len(tiles) > MAX_TILES:
            raise RefusedError("too_large", f"{len(tiles)} tiles: ask for a smaller box")
        self._cache.refresh(epoch)
        changed = self._cache.changed(request.level, tiles)
        return TileList(
            epoch=epoch.number,
            tile_side_m=lattice.tile_side_m,
            tiles=tiles,
            changed=np.minimum(changed, epoch.number),
        )

    def tile(self, request: TileRequest) -> Tile:
        """The mesh of one tile.

        Raises:
            RefusedError: a field is out of range, or the epoch is gone.
        """
        index = (request.x, request.y, request.z)
        if max(map(abs, index)) > TILE_INDEX_LIMIT:
            raise RefusedError(
                "bad_request",
                f"tile {index} is out of range: use -{TILE_INDEX_LIMIT} to {TILE_INDEX_LIMIT}",
            )
        check_level(request.level)
        check_fill(request.fill_m)
        epoch = self._epochs.get(request.epoch)
        lattice = self._cache.lattice(request.level)
        asked = (request.level, index, request.fill_m)
        tile = self._cache.answered.get(epoch.number, asked)
        if tile is None:
            # On the thread that answers alone: of a box full of tiles, others make more of them.
            view = ComposedView(epoch.number, epoch.field_settings, epoch.frozen_regions)
            mesh = mesh_tile(view, index, lattice, fill_m=request.fill_m)
            tile = Tile(
                epoch=epoch.number,
                changed=0,
                origin=mesh.origin,
                vertices=mesh.vertices,
                faces=mesh.faces,
                filled=mesh.filled.astype(np.uint8) if request.fill_m > 0 else None,
            )
            self._cache.answered.put(epoch.number, asked, tile)
        # A change that no refresh found yet shows in a later list: the tile is fetched again then.
        (changed,) = self._cache.changed(request.level, np.array([index])).tolist()
        return replace(tile, changed=min(changed, epoch.number))


def surface_tiles(epoch: Epoch, lattice: TileLattice, fill_m: float = 0.0) -> Ints:
    """Tiles [T, 3], sorted, that meet a block with seen surface, or what is meshed around it.

    That is more where the surface is continued up to ``fill_m``.
    """
    settings = epoch.field_settings
    side_m = BLOCK_VOXELS * settings.leaf_m
    corners = [np.zeros((0, 3))]
    for region in epoch.frozen_regions:
        origin = region.centre - settings.region_side_m / 2
        corners.append(region.evidence.surface_cells() * side_m + origin)
    low = np.concatenate(corners)
    margin_m = lattice.reach_m + fill_m
    return lattice.tiles_meeting(low, low + side_m, margin_m).astype(np.int32)
