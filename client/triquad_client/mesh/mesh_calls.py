"""Calls that fetch a surface as triangles, in the background of all else."""

from collections.abc import Iterator, Sequence

import numpy as np
from triquad_format.records.arrays import Bools, Ints
from triquad_format.wire import keys
from triquad_format.wire.messages import MeshReply, MeshRequest, TileList, TileListRequest
from triquad_map.triangles import TileJoin

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import BadReplyError
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.tile_decoder import TileDecoder
from triquad_client.net.call import NEWEST, Ask, Call, ask, offload, retried, take_each

_TILES_EACH = 8
"""Tiles of one request: alone, a small one costs as much on its way as in the making. Where holes
are filled, each may take a part of a second, and goes alone."""


def fetch_tiles(bounds: Bounds | None, level: int, fill_m: float = 0.0) -> Call[TileList]:
    """Return the tiles that meet the bounds."""
    minimum, maximum = checks.box(bounds)
    request = TileListRequest(
        minimum,
        maximum,
        NEWEST,
        level=checks.level_of_detail(level),
        fill_m=checks.length_to_fill(fill_m),
    )
    return (yield from ask(Ask(keys.TILE_LIST, request, TileList, background=True)))


def fetch_tile(index: Sequence[int], level: int, max_bytes: int) -> Call[Mesh]:
    """Return the newest mesh of one tile; errors as of :func:`fetch_mesh`."""
    level, tiles = checks.level_of_detail(level), checks.tile_indices(index)
    reply = yield from ask(_ask_mesh(tiles, NEWEST, level, fill_m=0.0))
    (tile,) = _decoded(reply, tiles, TileDecoder(max_bytes), filled=False)
    return tile


def fetch_mesh(
    bounds: Bounds | None, level: int, max_bytes: int, fill_m: float = 0.0
) -> Call[Mesh]:
    """Return the faces whose centroids lie in the bounds, from one epoch.

    Raises:
        BadReplyError: a reply is not valid.
        DownloadError: its tiles take more than ``max_bytes``.
    """
    box, level = checks.box(bounds), checks.level_of_detail(level)
    fill_m = checks.length_to_fill(fill_m)
    each = 1 if fill_m > 0 else _TILES_EACH

    def fetch() -> Call[Mesh]:
        listed = yield from fetch_tiles(bounds, level, fill_m)
        join = TileJoin(listed.tile_side_m, box, marked=fill_m > 0)
        firsts = range(0, len(listed.tiles), each)
        parts = [listed.tiles[first : first + each] for first in firsts]
        decoder = TileDecoder(max_bytes)

        def take(tiles: Ints, reply: MeshReply) -> None:
            for tile in _decoded(reply, tiles, decoder, filled=fill_m > 0):
                join.add(tile)

        yield from take_each(
            parts, lambda tiles: _ask_mesh(tiles, listed.epoch, level, fill_m=fill_m), take
        )
        return (yield from offload(lambda _: Mesh.of(join.mesh(), listed.epoch)))

    return (yield from retried("epoch_gone", fetch))


def _ask_mesh(tiles: Ints, epoch: int, level: int, fill_m: float) -> Ask[MeshReply]:
    request = MeshRequest(tiles, epoch=epoch, level=level, fill_m=fill_m)
    return Ask(keys.MESH, request, MeshReply, background=True)


def _decoded(
    reply: MeshReply, tiles: Ints, decoder: TileDecoder, *, filled: bool
) -> Iterator[Mesh]:
    """Yield the meshes of the tiles [T, 3] that were asked for, maybe ``filled``."""
    if filled != (reply.filled is not None):
        raise BadReplyError("filled: it came unasked, or did not come although it was asked for")
    surfaces = [tile.surface for tile in decoder.decode(reply.sizes, reply.data)]
    marks = _marks(reply, [len(surface.faces) for surface in surfaces])
    for index, surface, mark in zip(tiles.tolist(), surfaces, marks, strict=True):
        corner = np.array(index) * reply.tile_side_m
        yield Mesh(corner + surface.positions(reply.cell_m), surface.faces, mark, reply.epoch)


def _marks(reply: MeshReply, faces: list[int]) -> list[Bools | None]:
    """Return which faces fill holes, by tile, given the numbers of ``faces``; None: not asked."""
    if reply.filled is None:
        return [None] * len(faces)
    if len(reply.filled) != sum(faces):
        raise BadReplyError(f"filled: {len(reply.filled)} marks came for {sum(faces)} faces")
    return [*np.split(reply.filled.astype(np.bool_), np.cumsum(faces)[:-1])]
