"""Answers to queries of single mesh tiles, and of which there are."""

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.wire.messages import Tile, TileList, TileListRequest, TileRequest

from triquad_server.epochs.history import EpochHistory
from triquad_server.mesh.epoch_mesh import EpochMesh
from triquad_server.mesh.request_checks import check_box, check_index, check_level
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.settings import MeshSettings

MAX_TILES = 1_000_000
"""Tiles of one list."""


class TileQueries:
    """Answers mesh queries."""

    def __init__(self, epochs: EpochHistory, cache: TileCache, settings: MeshSettings) -> None:
        """``cache`` knows when tiles changed."""
        self._epochs = epochs
        self._cache = cache
        self._settings = settings

    def tiles(self, request: TileListRequest) -> TileList:
        """The tiles that meet the request's box."""
        check_box(request.minimum, request.maximum)
        check_level(request.level)
        epoch = self._epochs.get(request.epoch)
        mesh = EpochMesh(epoch, self._settings)
        tiles = mesh.tiles(request.minimum, request.maximum, request.level)
        if len(tiles) > MAX_TILES:
            raise RefusedError("too_large", f"{len(tiles)} tiles: ask for a smaller box")
        self._cache.refresh(epoch)
        changed = self._cache.changed(request.level, tiles)
        return TileList(
            epoch=epoch.number,
            tile_side_m=self._cache.lattice(request.level).tile_side_m,
            tiles=tiles,
            changed=np.minimum(changed, epoch.number),
        )

    def tile(self, request: TileRequest) -> Tile:
        """The mesh of one tile."""
        index = (request.x, request.y, request.z)
        check_index(index)
        check_level(request.level)
        epoch = self._epochs.get(request.epoch)
        mesh = EpochMesh(epoch, self._settings).tile(index, request.level)
        # A change that no refresh found yet shows in a later list: the tile is fetched again then.
        (changed,) = self._cache.changed(request.level, np.array([index])).tolist()
        return Tile(
            epoch=epoch.number,
            changed=min(changed, epoch.number),
            origin=mesh.origin,
            vertices=mesh.vertices,
            faces=mesh.faces,
        )
