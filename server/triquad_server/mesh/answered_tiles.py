"""Keeps the mesh tiles that were answered with, for the next client that asks for their epoch."""

import threading
from dataclasses import dataclass

from triquad_format.records.arrays import Bytes
from triquad_map.mesh.tile_lattice import TileIndex

_MAX_BYTES = 50_000_000
"""The bytes of the tiles that are kept: the mesh of some kilometre of street."""


@dataclass(frozen=True)
class TileRequest:
    """What is asked of a tile."""

    level: int  # of detail
    index: TileIndex
    fill_m: float  # holes up to this length are filled


@dataclass(frozen=True)
class AnsweredTile:
    """A tile in transmitted form."""

    data: bytes  # encoded by triquad_format.wire.tile_codec
    filled: Bytes  # [F] 1 for each face that fills a hole


class AnsweredTiles:
    """Keeps tiles of the newest epoch that was asked for any; safe for any thread.

    Those that come first stay: a client that asks for a mesh asks for all of its tiles in their
    order, so that the last would push out the first.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._epoch = 0
        self._tiles: dict[TileRequest, AnsweredTile] = {}
        self.nbytes = 0

    def get(self, epoch: int, request: TileRequest) -> AnsweredTile | None:
        """Return the tile of an epoch; None if it is not kept."""
        with self._lock:
            return self._tiles.get(request) if epoch == self._epoch else None

    def put(self, epoch: int, request: TileRequest, tile: AnsweredTile) -> None:
        """Keep a tile if there is room; those of earlier epochs go."""
        with self._lock:
            if epoch > self._epoch:
                self._epoch, self._tiles, self.nbytes = epoch, {}, 0
            grown = self.nbytes + len(tile.data) + tile.filled.nbytes
            if epoch == self._epoch and grown <= _MAX_BYTES and request not in self._tiles:
                self._tiles[request] = tile
                self.nbytes = grown
