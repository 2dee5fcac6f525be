"""Answers queries of mesh tiles, and of their list."""

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Ints
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.wire.limits import MAX_FILL_M, MAX_TILES_ASKED, TILE_INDEX_LIMIT
from triquad_format.wire.mesh_messages import MeshReply, MeshRequest, TileList, TileListRequest
from triquad_format.wire.tile_codec import encode_tile
from triquad_map.composition.composed_view import ComposedView
from triquad_map.mesh.mesher import mesh_tile
from triquad_map.mesh.tile_lattice import TileLattice, check_level
from triquad_map.questions.checks import check_box

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.mesh.answered_tiles import AnsweredTile, TileRequest
from triquad_server.mesh.tile_cache import TileCache

MAX_TILES = 1_000_000
"""The most tiles of one list."""


class TileQueries:
    """Answers mesh queries."""

    def __init__(self, epochs: EpochHistory, cache: TileCache) -> None:
        """Make the handler; ``cache`` knows when tiles changed."""
        self._epochs = epochs
        self._cache = cache

    def tiles(self, request: TileListRequest) -> TileList:
        """Return the tiles that meet the request's box.

        Raises:
            RefusedError: a field is out of range, the epoch is gone, or the tiles are too many.
        """
        check_box(request.minimum, request.maximum)
        check_level(request.level)
        _check_fill(request.fill_m)
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

    def mesh(self, request: MeshRequest) -> MeshReply:
        """Return the meshes of some tiles.

        Raises:
            RefusedError: a field is out of range, or the epoch is gone.
        """
        _check_tiles(request.tiles)
        check_level(request.level)
        _check_fill(request.fill_m)
        epoch = self._epochs.get(request.epoch)
        # In the answering thread alone: for a box full of tiles, other threads make more of them.
        view, lattice = epoch.with_split(), self._cache.lattice(request.level)
        tiles = [
            self._tile(view, TileRequest(request.level, (x, y, z), request.fill_m), lattice)
            for x, y, z in request.tiles.tolist()
        ]
        filled = np.concatenate([tile.filled for tile in tiles])
        return MeshReply(
            epoch=epoch.number,
            tile_side_m=lattice.tile_side_m,
            cell_m=lattice.cell_m,
            sizes=np.array([len(tile.data) for tile in tiles]),
            data=b"".join(tile.data for tile in tiles),
            filled=filled if request.fill_m > 0 else None,
        )

    def _tile(self, view: ComposedView, request: TileRequest, lattice: TileLattice) -> AnsweredTile:
        """Return a tile as it was answered before, or make it."""
        kept = self._cache.answered.get(view.epoch, request)
        if kept is not None:
            return kept
        mesh = mesh_tile(view, request.index, lattice, fill_m=request.fill_m)
        made = AnsweredTile(encode_tile(mesh.surface), mesh.filled.astype(np.uint8))
        self._cache.answered.put(view.epoch, request, made)
        return made


def _check_tiles(tiles: Ints) -> None:
    """Refuse indices [T, 3] of tiles that are out of range, and too many, or none.

    Raises:
        RefusedError: they are.
    """
    if not 1 <= len(tiles) <= MAX_TILES_ASKED:
        raise RefusedError("bad_request", f"{len(tiles)} tiles: ask for 1 to {MAX_TILES_ASKED}")
    beyond = (np.abs(tiles.astype(np.int64)) > TILE_INDEX_LIMIT).any(axis=1)
    if beyond.any():
        raise RefusedError(
            "bad_request",
            f"tile {tiles[beyond][0].tolist()} is out of range: "
            f"use -{TILE_INDEX_LIMIT} to {TILE_INDEX_LIMIT}",
        )


def _check_fill(fill_m: float) -> None:
    """Refuse a length up to which holes cannot be filled.

    Raises:
        RefusedError: it is not in the range.
    """
    if not 0 <= fill_m <= MAX_FILL_M:
        raise RefusedError(
            "bad_request", f"fill_m = {fill_m} is out of range: use 0 to {MAX_FILL_M:g}"
        )


def surface_tiles(epoch: Epoch, lattice: TileLattice, fill_m: float = 0.0) -> Ints:
    """Return the tiles [T, 3], sorted, that meet a block with seen surface, or the mesh around it.

    There are more if the surface is continued up to ``fill_m``.
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
