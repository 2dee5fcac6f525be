"""Tiles of the mesh of a ground that is moved, and what a cache has made of them."""

import numpy as np
from numpy.typing import NDArray
from support.maps.exact_maps import SETTINGS, Height, exact_map, table
from support.maps.map_records import with_region
from triquad_format.wire.tile_codec import TileSurface, decode_tile
from triquad_map.mesh.tile_mesh import TileIndex
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import ShownTile, TileCache
from triquad_server.settings import MeshSettings, Settings

EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)
MESH = MeshSettings(tile_cells=16)
_EPOCHS = iter(range(1, 1000))


def to_make(
    cache: TileCache, level: int = 0, box: tuple[NDArray[np.float64], ...] = EVERYWHERE
) -> list[TileIndex]:
    """The tiles in a box that do not show the current surface."""
    low, high = box
    changed = cache.changed(level, low, high, 0)
    return sorted(index for index in changed if cache.kept(level, index) is None)


def make_all(cache: TileCache, level: int = 0) -> list[TileIndex]:
    """Make what has to be made; returns it."""
    made: list[TileIndex] = []
    while missing := to_make(cache, level):
        for index in missing:
            cache.make(level, index)
        made += missing
    return made


def shown(cache: TileCache, level: int = 0) -> dict[TileIndex, ShownTile]:
    """All tiles with faces that show the current surface."""
    tiles = {index: cache.kept(level, index) for index in cache.changed(level, *EVERYWHERE, 0)}
    return {index: tile for index, tile in tiles.items() if tile is not None}


def surfaces(cache: TileCache, level: int = 0) -> dict[TileIndex, TileSurface]:
    """All tiles with faces, decoded."""
    found = {index: decode_tile(tile.data) for index, tile in shown(cache, level).items()}
    assert all(len(surface.faces) for surface in found.values()), "empty ones are not told of"
    return found


def bump(where: float, height_m: float) -> Epoch:
    """A flat ground at 0.3 m, with the square 2 m around (where, where) raised."""
    return ground(table(0.3, 0.3 + height_m, 2.0, (where, where)))


def ground(height: Height, **parts: object) -> Epoch:
    """A ground of that height, of whose region some ``parts`` are others."""
    record = with_region(exact_map(height, epoch=next(_EPOCHS)), **parts)
    return Mapper("test", Settings(field=SETTINGS, mesh=MESH), "cpu", record).publish()
