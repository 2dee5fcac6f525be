"""Answers queries of mesh tiles, of their list, and of those that changed."""

import time

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles, Ints
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.wire.mesh_messages import (
    MeshReply,
    MeshRequest,
    TileChanges,
    TileChangesRequest,
    TileList,
    TileListRequest,
)
from triquad_map.mesh.tile_mesh import TileIndex, TileLattice

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.mesh.tile_cache import ShownTile, TileCache

MAX_TILES = 1_000_000
"""The most tiles of one list."""

_ORIGIN = np.zeros(3)  # from where tiles count, which is told in the client's coordinates

_EVERYWHERE = np.full(3, np.inf)

_GIVE_WAY_S = 0.1  # seconds that the making of tiles waits for queries before each, at most
_MAX_REFRESH_SHARE = 4
"""Searches for changed tiles take at most one part in this many of the time."""


class TileQueries:
    """Answers mesh queries, one at a time.

    A client that follows the mesh asks which tiles changed, then for these, and after a while again
    which changed. Tiles that are followed are made when they are first asked for.
    """

    def __init__(self, epochs: EpochHistory, cache: TileCache, server: str) -> None:
        """Make the handler; ``server`` is the name that replies carry."""
        self._epochs = epochs
        self._cache = cache
        self._server = server
        self._next_refresh_s = 0.0  # monotonic

    def tiles(self, request: TileListRequest) -> TileList:
        """Return the tiles that meet the request's box.

        Raises:
            RefusedError: the epoch is gone, or the tiles are too many.
        """
        epoch = self._epochs.get(request.epoch)
        lattice = self._cache.lattice(request.level)
        tiles = surface_tiles(
            epoch, lattice, request.fill_m, low=request.minimum, high=request.maximum
        )
        tiles = tiles[lattice.meets(tiles, request.minimum, request.maximum)]
        if len(tiles) > MAX_TILES:
            raise RefusedError("too_large", f"{len(tiles)} tiles: ask for a smaller box")
        return TileList(epoch.number, lattice.tile_side_m, tiles, origin=_ORIGIN)

    def changes(self, request: TileChangesRequest) -> TileChanges:
        """Return in which tiles the surface changed.

        Raises:
            RefusedError: ``since`` was never given.
        """
        newest = self._epochs.newest
        self._refresh(newest)
        cache, lattice = self._cache, self._cache.lattice(request.level)
        since = request.since if request.server == self._server else 0
        revision = cache.revision(request.level)
        if not 0 <= since <= revision:
            raise RefusedError(
                "bad_request",
                f"since = {since} was never given by server {request.server!r}: use the revision "
                "of the reply before, or 0",
            )
        changed = cache.changed(request.level, request.minimum, request.maximum, since)
        return TileChanges(
            server=self._server,
            epoch=cache.epoch,
            revision=revision,
            is_newest=cache.epoch >= newest.number,
            tile_side_m=lattice.tile_side_m,
            cell_m=lattice.cell_m,
            tiles=np.array(list(changed), np.int32).reshape(-1, 3),
            changed=np.array(list(changed.values()), np.int64),
            origin=_ORIGIN,
        )

    def mesh(self, request: MeshRequest) -> MeshReply:
        """Return the meshes of some tiles.

        Raises:
            RefusedError: the epoch is gone, or none is given for tiles with filled holes.
        """
        if request.epoch == 0 and request.fill_m > 0:
            raise RefusedError("bad_request", "fill_m is for tiles of one epoch: name it")
        indices = [(x, y, z) for x, y, z in request.tiles.tolist()]
        if request.epoch == 0:
            return self._reply(request, self._cache.epoch, self._followed(request.level, indices))
        epoch = self._epochs.get(request.epoch)
        view = epoch.in_one_thread()
        tiles = self._cache.of_epoch(view, request.level, indices, request.fill_m)
        return self._reply(request, epoch.number, tiles)

    def _refresh(self, newest: Epoch) -> None:
        """Find what changed, if there may be something and the time for it is there."""
        started = time.monotonic()
        if newest.number > self._cache.epoch and started >= self._next_refresh_s:
            self._cache.refresh(newest)
            now = time.monotonic()
            self._next_refresh_s = now + _MAX_REFRESH_SHARE * (now - started)

    def _followed(self, level: int, indices: list[TileIndex]) -> list[ShownTile]:
        """Return tiles as they are followed; those that are out of date are made."""
        if self._cache.epoch < 0:
            self._cache.refresh(self._epochs.newest)
        shown = {index: self._cache.kept(level, index) for index in indices}
        while missing := [index for index, tile in shown.items() if tile is None]:
            self._epochs.give_way(_GIVE_WAY_S)
            shown.update(self._cache.make_some(level, missing))
        return [tile for index in indices if (tile := shown[index]) is not None]

    def _reply(self, request: MeshRequest, epoch: int, tiles: list[ShownTile]) -> MeshReply:
        lattice = self._cache.lattice(request.level)
        return MeshReply(
            epoch=epoch,
            tile_side_m=lattice.tile_side_m,
            cell_m=lattice.cell_m,
            sizes=np.array([len(tile.data) for tile in tiles]),
            data=b"".join(tile.data for tile in tiles),
            filled=np.concatenate([tile.filled for tile in tiles]) if request.fill_m > 0 else None,
            versions=np.array([tile.version for tile in tiles]),
        )


def surface_tiles(
    epoch: Epoch,
    lattice: TileLattice,
    fill_m: float = 0.0,
    low: Doubles = -_EVERYWHERE,
    high: Doubles = _EVERYWHERE,
) -> Ints:
    """Return the tiles [T, 3], sorted, that meet a block with seen surface, or the mesh around it.

    There are more if the surface is continued up to ``fill_m``. Those of regions far away from a
    box with the corners ``low`` and ``high`` [3] are left out.
    """
    settings = epoch.field_settings
    side_m, half_m = BLOCK_VOXELS * settings.leaf_m, settings.region_side_m / 2
    margin_m = lattice.reach_m + fill_m
    far_m = half_m + margin_m + lattice.tile_side_m
    corners = [np.zeros((0, 3))]
    for region in epoch.frozen_regions:
        if ((region.centre > low - far_m) & (region.centre < high + far_m)).all():
            cells = region.read_evidence().surface_cells()
            corners.append(cells * side_m + region.centre - half_m)
    blocks = np.concatenate(corners)
    return lattice.tiles_meeting(blocks, blocks + side_m, margin_m).astype(np.int32)
