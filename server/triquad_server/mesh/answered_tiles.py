"""Keeps tiles that were sent in replies, for the next client that requests the same epoch."""

import threading
from dataclasses import dataclass
from typing import NamedTuple

from triquad_format.records.arrays import Bytes
from triquad_map.compiled.mesh.tile_lattice import TileIndex


@dataclass(frozen=True)
class AskedTile:
    """The parameters of a requested tile."""

    level: int  # level of detail
    index: TileIndex
    fill_m: float  # length up to which holes are filled in it


class AnsweredTile(NamedTuple):
    """A tile in its transmitted form."""

    data: bytes  # encoded by triquad_format.wire.tile_codec
    filled: Bytes | None  # [F] 1 where a face fills a hole; None: none was to be filled

    @property
    def nbytes(self) -> int:
        """The bytes of memory that the tile takes."""
        return len(self.data) + (0 if self.filled is None else self.filled.nbytes)


class AnsweredTiles:
    """Keeps tiles of one epoch, the newest of which any was requested; safe for any thread.

    Those that come first stay. Otherwise they would push out each other where all do not fit, since
    a client that requests a mesh requests all tiles in their order.
    """

    def __init__(self, limit: int) -> None:
        """Keep at most ``limit`` bytes."""
        self._limit = limit
        self._lock = threading.Lock()
        self._epoch = 0
        self._tiles: dict[AskedTile, AnsweredTile] = {}
        self.nbytes = 0

    def get(self, epoch: int, asked: AskedTile) -> AnsweredTile | None:
        """Return the tile of an epoch as it was put; None if it is not there."""
        with self._lock:
            return self._tiles.get(asked) if epoch == self._epoch else None

    def put(self, epoch: int, asked: AskedTile, tile: AnsweredTile) -> None:
        """Keep a tile while there is room, and none of earlier epochs any more."""
        with self._lock:
            if epoch > self._epoch:
                self._epoch, self._tiles, self.nbytes = epoch, {}, 0
            grown = self.nbytes + tile.nbytes
            if epoch == self._epoch and grown <= self._limit and asked not in self._tiles:
                self._tiles[asked] = tile
                self.nbytes = grown
