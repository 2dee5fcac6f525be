"""Keeps the tiles of one level of detail as they were made, and which of them are out of date."""

import itertools
from collections import OrderedDict
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles
from triquad_map.mesh.tile_lattice import TileBorder, TileIndex, TileLattice

from triquad_server.mesh.surface_changes import Changes

_AROUND = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]

FOLLOWED = 0
"""The epoch by which tiles are kept that are followed."""


class TileKey(NamedTuple):
    """What a tile in transmitted form is kept by."""

    level: int  # of detail
    tile: TileIndex
    epoch: int = FOLLOWED  # all of which the tile is
    fill_m: float = 0.0  # holes up to this length are filled


@dataclass(frozen=True)
class ShownTile:
    """A tile in transmitted form."""

    version: int  # epoch of which it is
    data: bytes  # encoded by triquad_format.wire.tile_codec
    filled: Bytes  # [F] 1 for each face that fills a hole; [0] where none was to be filled

    @property
    def nbytes(self) -> int:
        """The bytes of memory that it takes."""
        return len(self.data) + self.filled.nbytes


class ShownTiles:
    """Keeps tiles in memory; those unused for longest are dropped if there are too many."""

    def __init__(self, limit: int) -> None:
        """Keep at most ``limit`` bytes, or a single tile that is larger."""
        self._limit = limit
        self._size = 0  # bytes of the tiles that are kept
        self._tiles: OrderedDict[TileKey, ShownTile] = OrderedDict()  # longest unused first

    def get(self, key: TileKey) -> ShownTile | None:
        """Return a tile; None if it was dropped."""
        tile = self._tiles.get(key)
        if tile is not None:
            self._tiles.move_to_end(key)
        return tile

    def put(self, key: TileKey, tile: ShownTile) -> None:
        """Keep a tile."""
        before = self._tiles.pop(key, None)
        self._size += tile.nbytes - (0 if before is None else before.nbytes)
        self._tiles[key] = tile
        while self._size > self._limit and len(self._tiles) > 1:
            _, dropped = self._tiles.popitem(last=False)
            self._size -= dropped.nbytes


@dataclass(frozen=True)
class CachedTile:
    """A tile that was made; its bytes may be dropped, what neighbours need of it never is."""

    made: int  # epoch of which it is
    empty: bool  # without faces
    border: TileBorder


class TileLevel:
    """Keeps the tiles of one level of detail, and when the surface of each changed."""

    def __init__(self, lattice: TileLattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, CachedTile] = {}  # as they were last made
        self.changed: dict[TileIndex, int] = {}  # epoch in which the surface last changed

    def clean(self, index: TileIndex) -> CachedTile | None:
        """Return the tile if it shows the current surface; None if it has to be made."""
        tile = self.tiles.get(index)
        return None if tile is None or tile.made < self.changed.get(index, 0) else tile

    def touch(self, index: TileIndex, epoch: int) -> None:
        """Record that the surface of a tile changed in ``epoch``."""
        self.changed.pop(index, None)
        self.changed[index] = epoch  # those that changed last are last

    def record(self, changes: Changes, half_m: float, epoch: int) -> None:
        """Record what changed in ``epoch``; voxels have sides of twice ``half_m``."""
        low, high = changes.places - half_m, changes.places + half_m
        touched = [
            *self.lattice.tiles_meeting(low, high, self.lattice.margin_m).tolist(),
            *self.lattice.tiles_meeting(changes.drifted, changes.drifted).tolist(),
        ]
        for x, y, z in touched:
            self.touch((x, y, z), epoch)

    def changed_since(self, low: Doubles, high: Doubles, since: int) -> dict[TileIndex, int]:
        """Return when the surface of tiles changed: of those for which it did after ``since``.

        They meet a box with the corners ``low`` and ``high`` [3], metres, map frame. Since epoch 0,
        those that are known to have no faces are left out.
        """
        newest_first = itertools.takewhile(
            lambda index: self.changed[index] > since, reversed(self.changed)
        )
        found = [index for index in newest_first if since or not self._is_empty(index)]
        inside = self.lattice.meets(np.array(found, np.int64).reshape(-1, 3), low, high)
        return {index: self.changed[index] for index in itertools.compress(found, inside)}

    def _is_empty(self, index: TileIndex) -> bool:
        tile = self.clean(index)
        return tile is not None and tile.empty

    def borders_around(self, index: TileIndex) -> dict[TileIndex, TileBorder]:
        """Return the borders with which a tile has to agree, by their tiles, in its own lattice.

        That is its own border if only its bytes were dropped, and those of all neighbours that show
        the current surface: these agree with each other. The others will be made to fit it.
        """
        found: dict[TileIndex, TileBorder] = {}
        own = self.clean(index)
        if own is not None:
            found[index] = own.border
        for offset in _AROUND:
            x, y, z = (a + b for a, b in zip(index, offset, strict=True))
            neighbour = self.clean((x, y, z))
            if neighbour is not None:
                found[x, y, z] = neighbour.border.seen_from(offset, self.lattice.cells)
        return found
