"""Calls that fetch a surface as triangles, in the background of all else."""

from collections.abc import Sequence

import numpy as np
from triquad_format.records.arrays import Ints
from triquad_format.wire import keys
from triquad_format.wire.messages import MeshReply, MeshRequest, TileList, TileListRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import BadReplyError, DownloadError
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.tile_join import TileJoin
from triquad_client.net.call import NEWEST, Ask, Call, ask, offload, retried, take_each

_TILES_EACH = 8
"""Tiles of one request: alone, a small one costs as much on its way as in the making."""


def fetch_tiles(bounds: Bounds | None, level: int, fill_m: float = 0.0) -> Call[TileList]:
    """The tiles that meet the bounds."""
    minimum, maximum = checks.box(bounds)
    request = TileListRequest(
        minimum,
        maximum,
        NEWEST,
        level=checks.level_of_detail(level),
        fill_m=checks.length_to_fill(fill_m),
    )
    return (yield from ask(Ask(keys.TILE_LIST, request, TileList, background=True)))


def fetch_tile(index: Sequence[int], level: int) -> Call[Mesh]:
    """The newest mesh of one tile."""
    level = checks.level_of_detail(level)
    reply = yield from ask(_ask_mesh(checks.tile_indices(index), NEWEST, level, fill_m=0.0))
    return _mesh_of(reply)


def fetch_mesh(
    bounds: Bounds | None, level: int, max_bytes: int, fill_m: float = 0.0
) -> Call[Mesh]:
    """The faces whose centroids lie in the bounds, from one epoch.

    Raises:
        BadReplyError: holes were to be filled, which a server of an earlier release does not do.
        DownloadError: its tiles take more than ``max_bytes``.
    """
    box = checks.box(bounds)

    def fetch() -> Call[Mesh]:
        listed = yield from fetch_tiles(bounds, level, fill_m)
        join = TileJoin(listed.tile_side_m, box, marked=fill_m > 0)
        nbytes = 0

        def take(reply: MeshReply) -> None:
            nonlocal nbytes
            if fill_m > 0 and reply.filled is None:
                raise BadReplyError("the reply lacks filled, which was asked for by fill_m")
            nbytes += reply.vertices.nbytes + reply.faces.nbytes
            if nbytes > max_bytes:
                raise too_large_error(max_bytes)
            join.add(_mesh_of(reply))

        yield from take_each(
            range(0, len(listed.tiles), _TILES_EACH),
            lambda first: _ask_mesh(
                listed.tiles[first : first + _TILES_EACH], listed.epoch, level, fill_m=fill_m
            ),
            take,
        )
        return (yield from offload(lambda _: join.mesh(listed.epoch)))

    return (yield from retried("epoch_gone", fetch))


def too_large_error(max_bytes: int) -> DownloadError:
    """The error for a mesh of more bytes."""
    return DownloadError(
        f"the mesh takes more than {max_bytes} bytes: ask for a smaller box or a coarser level, or "
        "connect with a larger max_download_bytes"
    )


def _ask_mesh(tiles: Ints, epoch: int, level: int, fill_m: float) -> Ask[MeshReply]:
    request = MeshRequest(tiles, epoch=epoch, level=level, fill_m=fill_m)
    return Ask(keys.MESH, request, MeshReply, background=True)


def _mesh_of(reply: MeshReply) -> Mesh:
    vertices = np.repeat(reply.origins, reply.counts, axis=0) + reply.vertices
    marks = None if reply.filled is None else reply.filled.astype(np.bool_)
    return Mesh(vertices, reply.faces, reply.epoch, filled=marks)
