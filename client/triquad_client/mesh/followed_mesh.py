"""The mesh of a box as a follower knows it: what it asks next, and what a reply makes of it."""

import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from triquad_format.wire.messages import TileUpdates, TileUpdatesRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import InvalidInputError
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.mesh_tiles import HeldTiles, MeshTile, TileIndex
from triquad_client.mesh.welding import joined

_REPLY_BYTES = 1_000_000
_MAX_HELD = 100_000  # the server's limit; of more the rest travels again


@dataclass(frozen=True)
class MeshUpdate:
    """What one reply changed."""

    changed: tuple[TileIndex, ...]  # tiles that are new or different
    removed: tuple[TileIndex, ...]
    epoch: int
    complete: bool  # all tiles show this epoch
    size: int  # bytes of the tiles as they came


@dataclass(frozen=True, eq=False)
class FollowedMesh:
    """What is known of the mesh tiles of a box; a reply gives another one."""

    minimum: NDArray[np.float64]  # [3] metres, map frame
    maximum: NDArray[np.float64]  # [3]
    level: int
    max_bytes_per_s: int  # 0: whatever the server allows
    name: str  # on which the server counts these bytes
    server: str = ""  # whose word all below is
    tile_side_m: float = math.nan
    tiles: Mapping[TileIndex, MeshTile] = field(default_factory=dict)
    void: frozenset[TileIndex] = frozenset()  # tiles of a server that is no more
    revision: int = 0
    epoch: int = 0
    complete: bool = False  # the last reply left nothing waiting

    @classmethod
    def to_begin_with(
        cls,
        bounds: Bounds | None,
        level: int,
        max_bytes_per_s: int | None,
        held: HeldTiles | None,
    ) -> "FollowedMesh":
        """Nothing, or what is held; arguments as of :meth:`Client.watch_mesh`.

        Raises:
            InvalidInputError: an argument cannot be used.
        """
        minimum, maximum = checks.box(bounds)
        checks.level_of_detail(level)
        rate = checks.bytes_per_second(max_bytes_per_s)
        empty = cls(minimum, maximum, level, rate, secrets.token_hex(8))
        if held is None:
            return empty
        if not isinstance(held, HeldTiles):
            raise InvalidInputError(
                f"held = {held!r}: give what an earlier watch's held() returned"
            )
        if held.level != level:
            raise InvalidInputError(f"the held tiles are of level {held.level}, not {level}")
        tiles = _meeting(minimum, maximum, held)
        return replace(empty, server=held.server, tile_side_m=held.tile_side_m, tiles=tiles)

    def request(self, wait_s: float) -> TileUpdatesRequest:
        """What to ask; the server answers once something changed, or after ``wait_s``."""
        # Until all is known, the server has to be told what is held; then the revision says it.
        known = [] if self.complete else list(self.held().tiles.values())[:_MAX_HELD]
        return TileUpdatesRequest(
            self.minimum,
            self.maximum,
            self.level,
            self.server,
            self.revision,
            np.array([tile.index for tile in known], np.int32).reshape(-1, 3),
            np.array([tile.version for tile in known], np.int64),
            _REPLY_BYTES,
            wait_s,
            self.name,
            self.max_bytes_per_s,
        )

    def after(self, reply: TileUpdates, changed: Mapping[TileIndex, MeshTile]) -> "FollowedMesh":
        """What is known after the reply to :meth:`request`; ``changed`` are its tiles."""
        old = frozenset(self.tiles) if reply.restart else self.void
        void = old - changed.keys()
        removed = {(x, y, z) for x, y, z in reply.removed.tolist()}
        if reply.complete:
            removed |= void
        tiles = {**self.tiles, **changed}
        return replace(
            self,
            server=reply.server,
            tile_side_m=reply.tile_side_m,
            tiles={index: tile for index, tile in tiles.items() if index not in removed},
            void=void - removed,
            revision=reply.revision,
            epoch=reply.epoch,
            complete=reply.complete,
        )

    def mesh(self) -> Mesh:
        """The tiles as one mesh, faces by their centroids within the bounds."""
        triangles = [(tile.origin + tile.vertices, tile.faces) for tile in self.tiles.values()]
        if not triangles:
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), self.epoch)
        return Mesh(*joined(triangles, self.tile_side_m, self.minimum, self.maximum), self.epoch)

    def held(self) -> HeldTiles:
        """The tiles to go on with."""
        tiles = {index: tile for index, tile in self.tiles.items() if index not in self.void}
        return HeldTiles(self.server, self.level, self.tile_side_m, tiles)


def _meeting(
    minimum: NDArray[np.float64], maximum: NDArray[np.float64], held: HeldTiles
) -> dict[TileIndex, MeshTile]:
    """The held tiles that meet a box: others would not be kept up to date."""
    return {
        index: tile
        for index, tile in held.tiles.items()
        if (tile.origin <= maximum).all() and (tile.origin + held.tile_side_m >= minimum).all()
    }
