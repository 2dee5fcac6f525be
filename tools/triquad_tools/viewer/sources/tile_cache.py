"""Mesh tiles that were made here, and those that are kept."""

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MadeTile:
    """The mesh of one tile."""

    version: int  # epoch of the map
    origin: NDArray[np.float64]  # [3] metres, map frame: the minimum corner
    vertices: NDArray[np.float32]  # [V, 3] metres, relative to the origin
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space

    @property
    def size_bytes(self) -> int:
        """What it takes in memory."""
        return self.vertices.nbytes + self.faces.nbytes


class TileCache:
    """The tiles that were used last, up to so many bytes. Not for several threads."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._tiles: OrderedDict[Hashable, MadeTile] = OrderedDict()
        self.size_bytes = 0

    def get(self, name: Hashable) -> MadeTile | None:
        """The tile of that name, if it is there."""
        if name in self._tiles:
            self._tiles.move_to_end(name)
        return self._tiles.get(name)

    def put(self, name: Hashable, tile: MadeTile) -> None:
        """Keep a tile; others may have to go."""
        before = self._tiles.pop(name, None)
        self._tiles[name] = tile
        self.size_bytes += tile.size_bytes - (before.size_bytes if before else 0)
        while self.size_bytes > self._max_bytes:
            self.size_bytes -= self._tiles.popitem(last=False)[1].size_bytes
