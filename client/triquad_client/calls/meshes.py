"""Fetching mesh tiles, and whole meshes from them. It goes in the background of all else."""

import numpy as np
from numpy.typing import NDArray
from triquad_format.wire import keys
from triquad_format.wire.messages import Tile, TileList, TileListRequest, TileRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.welding import Triangles, joined
from triquad_client.net.call import Ask, Call, Run, ask, ask_each, offload, retried


def tiles(bounds: Bounds | None, level: int) -> Call[TileList]:
    """The tiles that meet the bounds."""
    return (yield from _tiles(*checks.box(bounds), checks.level_of_detail(level)))


def tile(x: int, y: int, z: int, level: int) -> Call[Mesh]:
    """The newest mesh of one tile."""
    tile = yield from ask(_tile((x, y, z), 0, checks.level_of_detail(level)))
    return Mesh(tile.origin + tile.vertices.astype(np.float64), tile.faces, tile.epoch)


def mesh(bounds: Bounds | None, level: int) -> Call[Mesh]:
    """The faces whose centroids lie in the bounds, from one epoch."""
    minimum, maximum = checks.box(bounds)
    checks.level_of_detail(level)
    return (yield from retried("epoch_gone", lambda: _mesh(minimum, maximum, level)))


def _mesh(minimum: NDArray[np.float64], maximum: NDArray[np.float64], level: int) -> Call[Mesh]:
    listed = yield from _tiles(minimum, maximum, level)
    indices = [(int(x), int(y), int(z)) for x, y, z in listed.tiles]
    tiles = yield from ask_each(indices, lambda index: _tile(index, listed.epoch, level))

    def join(_: Run) -> Mesh:
        parts = [Triangles(tile.origin + tile.vertices, tile.faces) for tile in tiles]
        whole = joined(parts, listed.tile_side_m, minimum, maximum)
        return Mesh(whole.vertices, whole.faces, listed.epoch)

    return (yield from offload(join))


def _tiles(
    minimum: NDArray[np.float64], maximum: NDArray[np.float64], level: int
) -> Call[TileList]:
    request = TileListRequest(minimum=minimum, maximum=maximum, epoch=0, level=level)
    return (yield from ask(Ask(keys.TILE_LIST, request, TileList, background=True)))


def _tile(index: tuple[int, int, int], epoch: int, level: int) -> Ask[Tile]:
    return Ask(keys.TILE, TileRequest(*index, epoch, level), Tile, background=True)
