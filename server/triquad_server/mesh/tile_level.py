"""The mesh tiles of one level of detail: which there are, and which of them are out of date."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_server.mesh.surface_changes import Changes
from triquad_server.mesh.tile_lattice import TileBorder, TileIndex, TileLattice, tiles_meeting

_AROUND = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]


@dataclass(frozen=True)
class CachedTile:
    """A tile that was made. Its bytes may be gone; what neighbours need of it never is."""

    index: TileIndex
    version: int  # epoch of which its bytes are
    revision: int  # its place in the order in which bytes came to differ
    made: int  # epoch with which it was last found to agree
    empty: bool  # without faces
    digest: bytes
    border: TileBorder


@dataclass(frozen=True)
class TileDelta:
    """What somebody does not know of the tiles of a box."""

    ready: list[CachedTile]  # by increasing revision; empty ones are to be removed
    removed: list[TileIndex]  # that the other side has, and that were never here
    to_make: list[TileIndex]  # those that changed first come first
    revision: int  # who knows all of this knows everything up to here


class TileLevel:
    """The tiles of one level of detail. Not safe for several threads at a time."""

    def __init__(self, lattice: TileLattice) -> None:
        self.lattice = lattice
        self._tiles: dict[TileIndex, CachedTile] = {}
        self._changed: dict[TileIndex, int] = {}  # epoch in which the surface last changed
        self._indices = np.zeros((0, 3), np.int64)  # of ``_changed``

    def changed(self, index: TileIndex) -> int:
        """The epoch in which a tile's surface last changed; 0 where none was seen."""
        return self._changed.get(index, 0)

    def tile(self, index: TileIndex) -> CachedTile | None:
        """The tile as it was last made."""
        return self._tiles.get(index)

    def clean(self, index: TileIndex) -> CachedTile | None:
        """The tile where it shows what the map has; None where it has to be made."""
        tile = self._tiles.get(index)
        return tile if tile is not None and self.changed(index) <= tile.made else None

    def put(self, tile: CachedTile) -> None:
        """Enter a tile that was made."""
        self._tiles[tile.index] = tile

    def invalidate(self, index: TileIndex, epoch: int) -> None:
        """Have a tile made again that does not show what ``epoch`` has."""
        self._changed[index] = max(self._changed[index], epoch)

    def record(self, changes: Changes, half_m: float, epoch: int) -> None:
        """Record what changed in ``epoch``; voxels have sides of twice ``half_m``."""
        low, high = changes.places - half_m, changes.places + half_m
        touched = [
            *tiles_meeting(low, high, self.lattice.margin_m, self.lattice).tolist(),
            *tiles_meeting(changes.drifted, changes.drifted, 0.0, self.lattice).tolist(),
        ]
        known = len(self._changed)
        for x, y, z in touched:
            self._changed[x, y, z] = epoch
        if len(self._changed) > known:
            self._indices = np.array(list(self._changed), np.int64)

    def delta(
        self,
        low: Doubles,
        high: Doubles,
        known_to: int,
        held: Mapping[TileIndex, int],
        revision: int,
    ) -> TileDelta:
        """What is new in a box to somebody who knows everything up to the revision ``known_to``.

        ``held`` are versions of tiles that are known whatever the revision; ``revision`` is that of
        the newest tile of any level.
        """
        ready: list[CachedTile] = []
        to_make: list[TileIndex] = []
        inside = self._indices[self.lattice.meets(self._indices, low, high)]
        for x, y, z in inside.tolist():
            index = (x, y, z)
            tile = self.clean(index)
            if tile is None:
                to_make.append(index)
                continue
            unknown = tile.revision > known_to and held.get(index) != tile.version
            if unknown and (not tile.empty or known_to or index in held):
                ready.append(tile)
        ready.sort(key=lambda tile: tile.revision)
        to_make.sort(key=lambda index: (self._changed[index], index))
        removed = [index for index in held if index not in self._changed]
        return TileDelta(ready, removed, to_make, revision)

    def borders_around(self, index: TileIndex) -> dict[TileIndex, TileBorder]:
        """What a tile has to agree with, by the tiles whose it is, in its own lattice.

        That is its own border where only its bytes are gone, and those of all neighbours that show
        what the map has: these agree with each other. The others will be made to fit it.
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
