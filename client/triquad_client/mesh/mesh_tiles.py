"""Mesh tiles as a client holds them."""

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
    size: int  # bytes as they came
    origin: NDArray[np.float64]  # [3] metres, map frame: the minimum corner
    vertices: NDArray[np.float32]  # [V, 3] metres, relative to the origin
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space


@dataclass(frozen=True)
class HeldTiles:
    """Tiles to go on with: :meth:`MeshWatch.held` gives them, :meth:`Client.watch_mesh` takes them.

    They are of one level of one server process. Where that was restarted they are fetched anew.
    """

    server: str
    level: int
    tile_side_m: float
    tiles: Mapping[TileIndex, MeshTile] = field(default_factory=dict)


def unpacked(updates: TileUpdates) -> list[MeshTile]:
    """The tiles of a reply.

    Raises:
        BadReplyError: they are not sound.
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
                (x, y, z),
                int(updates.versions[row]),
                hashlib.sha256(data).hexdigest(),
                len(data),
                np.array((x, y, z)) * updates.tile_side_m,
                surface.positions(updates.cell_m),
                surface.faces,
            )
        )
    return tiles
