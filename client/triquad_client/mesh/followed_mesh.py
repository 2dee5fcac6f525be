"""The mesh of a box as a follower knows it: what it asks next, and what a reply makes of it."""

import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from triquad_format.wire.limits import MAX_KNOWN_TILES
from triquad_format.wire.messages import TileUpdates, TileUpdatesRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import InvalidInputError
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.mesh_tiles import KnownTiles, MeshTile, TileIndex
from triquad_client.mesh.welding import Triangles, joined

_REPLY_BYTES = 1_000_000


@dataclass(frozen=True)
class MeshUpdate:
    """What one reply changed."""

    changed: tuple[TileIndex, ...]  # tiles that are new or different
    removed: tuple[TileIndex, ...]
    epoch: int
    complete: bool  # all tiles show this epoch
    size_bytes: int  # of the tiles as they came


@dataclass(frozen=True, eq=False)
class FollowedMesh:
    """What is known of the mesh tiles of a box; a reply gives another one."""

    minimum: NDArray[np.float64]  # [3] metres, map frame
    maximum: NDArray[np.float64]  # [3]
    level: int
    max_bytes_per_s: int  # 0: whatever the server allows
    name: str  # on which the server counts these bytes
    server: str = ""  # which told all below
    tile_side_m: float = math.nan
    tiles: Mapping[TileIndex, MeshTile] = field(default_factory=dict)
    stale: frozenset[TileIndex] = frozenset()  # tiles of a server that is no more
    revision: int = 0
    epoch: int = 0
    complete: bool = False  # the last reply left nothing waiting

    @classmethod
    def initial(
        cls,
        bounds: Bounds | None,
        level: int,
        max_bytes_per_s: int | None,
        known: KnownTiles | None,
    ) -> "FollowedMesh":
        """Nothing, or the ``known`` tiles; arguments as of :meth:`Client.watch_mesh`.

        Raises:
            InvalidInputError: an argument cannot be used.
        """
        minimum, maximum = checks.box(bounds)
        checks.level_of_detail(level)
        rate = checks.bytes_per_second(max_bytes_per_s)
        empty = cls(minimum, maximum, level, rate, secrets.token_hex(8))
        if known is None:
            return empty
        if not isinstance(known, KnownTiles):
            raise InvalidInputError(
                f"known = {known!r}: give what an earlier watch's known_tiles() returned"
            )
        if known.level != level:
            raise InvalidInputError(f"the known tiles are of level {known.level}, not {level}")
        tiles = _meeting(minimum, maximum, known)
        return replace(empty, server=known.server, tile_side_m=known.tile_side_m, tiles=tiles)

    def request(self, wait_s: float) -> TileUpdatesRequest:
        """What to ask; the server answers once something changed, or after ``wait_s``."""
        # Until all is known, the server has to be told which tiles are; then the revision says it.
        # Of more than may be named, the rest travels again.
        known = [] if self.complete else list(self.known_tiles().tiles.values())[:MAX_KNOWN_TILES]
        return TileUpdatesRequest(
            minimum=self.minimum,
            maximum=self.maximum,
            level=self.level,
            server=self.server,
            revision=self.revision,
            held=np.array([tile.index for tile in known], np.int32).reshape(-1, 3),
            held_versions=np.array([tile.version for tile in known], np.int64),
            max_bytes=_REPLY_BYTES,
            timeout_s=wait_s,
            client=self.name,
            max_bytes_per_s=self.max_bytes_per_s,
        )

    def after(self, reply: TileUpdates, changed: Mapping[TileIndex, MeshTile]) -> "FollowedMesh":
        """What is known after the reply to :meth:`request`; ``changed`` are its tiles."""
        old = frozenset(self.tiles) if reply.restart else self.stale
        stale = old - changed.keys()
        removed = {(x, y, z) for x, y, z in reply.removed.tolist()}
        if reply.complete:
            removed |= stale
        tiles = {**self.tiles, **changed}
        return replace(
            self,
            server=reply.server,
            tile_side_m=reply.tile_side_m,
            tiles={index: tile for index, tile in tiles.items() if index not in removed},
            stale=stale - removed,
            revision=reply.revision,
            epoch=reply.epoch,
            complete=reply.complete,
        )

    def mesh(self) -> Mesh:
        """The tiles as one mesh, faces by their centroids within the bounds."""
        tiles = [Triangles(tile.origin + tile.vertices, tile.faces) for tile in self.tiles.values()]
        whole = joined(tiles, self.tile_side_m, self.minimum, self.maximum)
        return Mesh(whole.vertices, whole.faces, self.epoch)

    def known_tiles(self) -> KnownTiles:
        """The tiles to go on with."""
        tiles = {index: tile for index, tile in self.tiles.items() if index not in self.stale}
        return KnownTiles(
            server=self.server, level=self.level, tile_side_m=self.tile_side_m, tiles=tiles
        )


def _meeting(
    minimum: NDArray[np.float64], maximum: NDArray[np.float64], known: KnownTiles
) -> dict[TileIndex, MeshTile]:
    """The known tiles that meet a box: others would not be kept up to date."""
    return {
        index: tile
        for index, tile in known.tiles.items()
        if (tile.origin <= maximum).all() and (tile.origin + known.tile_side_m >= minimum).all()
    }
