"""Answers to queries of single mesh tiles, and of which there are; checks of what is asked."""

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.messages import Tile, TileList, TileListRequest, TileRequest

from triquad_server.epochs import EpochHistory
from triquad_server.mesh.mesher import mesh_tile, surface_tiles
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_lattice import TileIndex

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
        """The tiles that meet the request's box."""
        check_box(request.minimum, request.maximum)
        check_level(request.level)
        epoch = self._epochs.get(request.epoch)
        lattice = self._cache.lattice(request.level)
        tiles = surface_tiles(epoch, lattice)
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
        """The mesh of one tile."""
        index = (request.x, request.y, request.z)
        check_index(index)
        check_level(request.level)
        epoch = self._epochs.get(request.epoch)
        mesh = mesh_tile(epoch, index, self._cache.lattice(request.level))
        # A change that no refresh found yet shows in a later list: the tile is fetched again then.
        (changed,) = self._cache.changed(request.level, np.array([index])).tolist()
        return Tile(
            epoch=epoch.number,
            changed=min(changed, epoch.number),
            origin=mesh.origin,
            vertices=mesh.vertices,
            faces=mesh.faces,
        )


def check_level(level: int) -> None:
    """Refuse a level of detail that there is not."""
    if not 0 <= level < LEVELS:
        raise RefusedError("bad_request", f"level = {level} is out of range: use 0 to {LEVELS - 1}")


def check_box(minimum: Doubles, maximum: Doubles) -> None:
    """Refuse a box [3], [3] with NaN or with corners the wrong way round; infinite is allowed."""
    if np.isnan([minimum, maximum]).any() or (minimum > maximum).any():
        raise RefusedError("bad_request", f"not a box: minimum {minimum}, maximum {maximum}")


def check_index(index: TileIndex) -> None:
    """Refuse a tile that is too far away."""
    if max(map(abs, index)) > TILE_INDEX_LIMIT:
        raise RefusedError(
            "bad_request",
            f"tile {index} is out of range: use -{TILE_INDEX_LIMIT} to {TILE_INDEX_LIMIT}",
        )
