"""Encoded mesh tiles in memory, up to a limit."""

from collections import OrderedDict

from triquad_server.mesh.mesher import TileIndex

TileKey = tuple[int, TileIndex]
"""Level of detail and index of a tile."""


class TileBytes:
    """Encoded tiles; those unused for longest are dropped where there are too many."""

    def __init__(self, limit: int) -> None:
        """Keep at most ``limit`` bytes, or a single tile that is larger."""
        self._limit = limit
        self._size = 0
        self._data: OrderedDict[TileKey, bytes] = OrderedDict()  # longest unused first

    @property
    def size(self) -> int:
        """Bytes of the tiles that are kept."""
        return self._size

    def get(self, key: TileKey) -> bytes | None:
        """The bytes of a tile, None where they are gone."""
        data = self._data.get(key)
        if data is not None:
            self._data.move_to_end(key)
        return data

    def put(self, key: TileKey, data: bytes) -> None:
        """Keep the bytes of a tile."""
        self._size += len(data) - len(self._data.pop(key, b""))
        self._data[key] = data
        while self._size > self._limit and len(self._data) > 1:
            _, dropped = self._data.popitem(last=False)
            self._size -= len(dropped)
