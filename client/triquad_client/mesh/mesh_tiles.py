"""Mesh tiles as a client keeps them."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import WireError
from triquad_format.wire.messages import TileUpdates
from triquad_format.wire.tile_codec import decode_tile

from triquad_client.errors import BadReplyError

TileIndex = tuple[int, int, int]


@dataclass(frozen=True)
class MeshTile:
    """The mesh of one tile: ``tile_side_m`` times its index is its minimum corner."""

    index: TileIndex
    version: int  # epoch of which it is
    digest: str  # SHA-256 of the bytes as they came, 64 hexadecimal digits
    size_bytes: int  # as they came
    origin: NDArray[np.float64]  # [3] metres, map frame: the minimum corner
    vertices: NDArray[np.float32]  # [V, 3] metres, relative to the origin
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space


@dataclass(frozen=True)
class KnownTiles:
    """Tiles for a later watch to go on with.

    :meth:`MeshWatch.known_tiles` gives them, :meth:`Client.watch_mesh` takes them.

    They are of one level of one server process. Where that was restarted they are fetched anew.
    """

    server: str
    level: int
    tile_side_m: float
    tiles: Mapping[TileIndex, MeshTile] = field(default_factory=dict)


def unpacked(updates: TileUpdates) -> list[MeshTile]:
    """The tiles of a reply.

    Raises:
        BadReplyError: they are not valid.
    """
    if not (math.isfinite(updates.tile_side_m) and updates.tile_side_m > 0):
        raise BadReplyError(f"tiles of side {updates.tile_side_m}")
    count = len(updates.tiles)
    sizes = updates.sizes
    lengths = {len(updates.versions), len(sizes)}
    if lengths != {count} or (sizes < 0).any() or int(sizes.sum()) != len(updates.data):
        raise BadReplyError(f"a reply of {count} tiles has parts of other lengths")
    ends = np.cumsum(sizes).tolist()
    tiles = []
    for row, (x, y, z) in enumerate(updates.tiles.tolist()):
        data = updates.data[ends[row] - int(sizes[row]) : ends[row]]
        try:
            surface = decode_tile(data)
        except WireError as error:
            raise BadReplyError(f"tile {(x, y, z)}: {error}") from error
        tiles.append(
            MeshTile(
                index=(x, y, z),
                version=int(updates.versions[row]),
                digest=hashlib.sha256(data).hexdigest(),
                size_bytes=len(data),
                origin=np.array((x, y, z)) * updates.tile_side_m,
                vertices=surface.positions(updates.cell_m),
                faces=surface.faces,
            )
        )
    return tiles
