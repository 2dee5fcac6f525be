"""The call that fetches a surface as triangles, in the background of all else."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from triquad_format.records.arrays import Bools, Ints
from triquad_format.wire.codec import known_origin
from triquad_format.wire.limits import MAX_FILL_M
from triquad_format.wire.mesh_messages import MeshReply, MeshRequest, TileListRequest
from triquad_map.triangles import TileJoin

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import BadReplyError
from triquad_client.mesh.followed_mesh import TileDecoder
from triquad_client.mesh.mesh import Mesh
from triquad_client.net.connection import NEWEST, Connection, retried

_TILES_EACH = 8
"""Tiles of one request: alone, a small one costs as much on its way as in the making. Where holes
are filled, each may take a part of a second, and goes alone."""


class MeshCalls:
    """The call that fetches the mesh, as it is now."""

    _connection: Connection

    def mesh(self, bounds: Bounds | None = None, level: int = 0, fill_m: float = 0.0) -> Mesh:
        """Return the mesh in ``bounds`` (faces by their centroids), its tiles joined, of one epoch.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everywhere.
            level: of detail: 0, 1 or 2, each with cells twice as large as the one before.
            fill_m: also the surface up to so far from what was seen, 0 to 5 m, where the field
                continues it into ``UNKNOWN`` space; those faces are marked in ``Mesh.filled``.
        """
        box, level = checks.box(bounds), checks.level_of_detail(level)
        fill_m = checks.within("fill_m", fill_m, MAX_FILL_M, least=0.0)
        each = 1 if fill_m > 0 else _TILES_EACH
        request = TileListRequest(*box, NEWEST, level=level, fill_m=fill_m)

        def fetch() -> Mesh:
            listed = self._connection.ask(request)
            # Joined from where tiles count, which is a corner of one.
            origin = known_origin(listed.origin)
            low, high = box[0] - origin, box[1] - origin
            join = TileJoin(listed.tile_side_m, (low, high), marked=fill_m > 0)
            decoder = TileDecoder(self._connection.max_download_bytes)
            firsts = range(0, len(listed.tiles), each)
            parts = [listed.tiles[first : first + each] for first in firsts]
            asked = (MeshRequest(tiles, listed.epoch, level, fill_m) for tiles in parts)
            for tiles, reply in zip(parts, self._connection.replies(asked), strict=True):
                for tile in _decoded(reply, tiles, decoder, filled=fill_m > 0):
                    join.add(tile)
            return Mesh.of(join.mesh().moved(origin), listed.epoch)

        return retried("epoch_gone", fetch)


def _decoded(
    reply: MeshReply, tiles: Ints, decoder: TileDecoder, *, filled: bool
) -> Iterator[Mesh]:
    """Yield the meshes of the tiles [T, 3] that were asked for, maybe ``filled``."""
    if filled != (reply.filled is not None):
        raise BadReplyError("filled: it came unasked, or did not come although it was asked for")
    surfaces = list(decoder.decode(reply.sizes, reply.data))
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
