"""A reply to a follower of the mesh, while tiles are put into it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from triquad_format.wire.messages import TileUpdates

from triquad_server.mesh.mesher import TileIndex
from triquad_server.mesh.tile_lattice import TileLattice
from triquad_server.mesh.tile_level import CachedTile


@dataclass
class TileReply:
    """Tiles on their way to one follower."""

    complete: bool  # nothing more waits
    revision: int  # up to which the follower knows everything once it has the reply
    removed: list[TileIndex] = field(default_factory=list)
    tiles: list[CachedTile] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)  # of each tile

    @property
    def size(self) -> int:
        """Bytes of its tiles."""
        return sum(map(len, self.data))

    def fits(self, data: bytes, limit: float) -> bool:
        """Whether a tile may be added: the first always may."""
        return not data or not self.data or self.size + len(data) <= limit

    def add(self, tile: CachedTile, data: bytes) -> None:
        """Add a tile with its bytes; one without faces is to be removed."""
        self.revision = tile.revision
        if tile.empty:
            self.removed.append(tile.index)
        else:
            self.tiles.append(tile)
            self.data.append(data)

    def message(
        self, *, server: str, epoch: int, restart: bool, lattice: TileLattice
    ) -> TileUpdates:
        """The reply as it travels."""
        return TileUpdates(
            server=server,
            revision=self.revision,
            epoch=epoch,
            complete=self.complete,
            restart=restart,
            tile_side_m=lattice.tile_side_m,
            cell_m=lattice.cell_m,
            tiles=_indices([tile.index for tile in self.tiles]),
            versions=np.array([tile.version for tile in self.tiles], np.int64),
            sizes=np.array([len(data) for data in self.data], np.int64),
            data=b"".join(self.data),
            removed=_indices(self.removed),
        )


def _indices(tiles: list[TileIndex]) -> NDArray[np.int32]:
    return np.array(tiles, np.int32).reshape(-1, 3)
