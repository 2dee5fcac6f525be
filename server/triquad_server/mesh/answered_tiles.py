"""Tiles as they were answered with, for whoever asks for the same epoch next."""

import threading

import zstandard
from triquad_format.wire import codec
from triquad_format.wire.messages import MeshReply

from triquad_server.mesh.mesher import TileIndex

_LEVEL = 1
"""Of compression: a street's tiles then take 40 % of their bytes; level 3 makes it 39 %."""

AskedTile = tuple[int, TileIndex, float]
"""Level of detail and index of a tile, and how far holes are filled in it, metres."""


class AnsweredTiles:
    """Tiles of one epoch, the newest of which any was asked for; safe for any thread.

    Those that come first stay. Others would push out each other where all do not fit, since who
    asks for a mesh asks for all tiles in their order.
    """

    def __init__(self, limit: int) -> None:
        """Keep at most ``limit`` bytes."""
        self._limit = limit
        self._lock = threading.Lock()
        self._epoch = 0
        self._data: dict[AskedTile, bytes] = {}
        self.nbytes = 0

    def get(self, epoch: int, asked: AskedTile) -> MeshReply | None:
        """The tile of an epoch as it was put; None where it was not, or is gone."""
        with self._lock:
            data = self._data.get(asked) if epoch == self._epoch else None
        return None if data is None else codec.decode(MeshReply, zstandard.decompress(data))

    def put(self, epoch: int, asked: AskedTile, tile: MeshReply) -> None:
        """Keep a tile while there is room, and none of earlier epochs any more."""
        with self._lock:
            if epoch > self._epoch:
                self._epoch, self._data, self.nbytes = epoch, {}, 0
            if epoch < self._epoch or self.nbytes >= self._limit:
                return
        compressed = zstandard.ZstdCompressor(level=_LEVEL).compress(codec.encode(tile))
        # What zstandard returns has the room of the worst case behind it, two thirds of its memory.
        data = bytes(memoryview(compressed))
        with self._lock:
            grown = self.nbytes + len(data)
            if epoch == self._epoch and grown <= self._limit and asked not in self._data:
                self._data[asked] = data
                self.nbytes = grown
