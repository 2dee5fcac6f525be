"""Keeps the tiles of one level of detail as they were made, and which of them are out of date."""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_map.mesh.tile_lattice import TileBorder, TileIndex, TileLattice

from triquad_server.mesh.surface_changes import Changes

_AROUND = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]

TileKey = tuple[int, TileIndex]
"""The level of detail and the index of a tile."""


class TileBytes:
    """Keeps encoded tiles in memory; those unused for longest are dropped if there are too many."""

    def __init__(self, limit: int) -> None:
        """Keep at most ``limit`` bytes, or a single tile that is larger."""
        self._limit = limit
        self.size = 0  # bytes of the tiles that are kept
        self._data: OrderedDict[TileKey, bytes] = OrderedDict()  # longest unused first

    def get(self, key: TileKey) -> bytes | None:
        """Return the bytes of a tile; None if they were dropped."""
        data = self._data.get(key)
        if data is not None:
            self._data.move_to_end(key)
        return data

    def put(self, key: TileKey, data: bytes) -> None:
        """Keep the bytes of a tile."""
        self.size += len(data) - len(self._data.pop(key, b""))
        self._data[key] = data
        while self.size > self._limit and len(self._data) > 1:
            _, dropped = self._data.popitem(last=False)
            self.size -= len(dropped)


@dataclass(frozen=True)
class CachedTile:
    """A tile that was made; its bytes may be dropped, what neighbours need of it never is."""

    index: TileIndex
    version: int  # epoch of which its bytes are
    revision: int  # its place in the order in which bytes came to differ
    made: int  # epoch with which it was last found to agree
    empty: bool  # without faces
    digest: bytes
    border: TileBorder


@dataclass(frozen=True)
class TileDelta:
    """The changes of the tiles of a box for one client."""

    ready: list[CachedTile]  # by increasing revision; empty ones are to be removed
    removed: list[TileIndex]  # known to the client, and never in this cache
    missing: list[TileIndex]  # that were never made
    outdated: list[TileIndex]  # to be made again, those made longest ago first
    revision: int  # a client with all of this knows everything up to here
    known_to: int  # the most up to which one knows everything that lacks what is to be made

    @property
    def to_make(self) -> list[TileIndex]:
        """The tiles that have to be made, the most needed first."""
        return self.missing + self.outdated


class TileLevel:
    """Keeps the tiles of one level of detail, and which of them are out of date."""

    def __init__(self, lattice: TileLattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, CachedTile] = {}  # as they were last made
        self.changed: dict[TileIndex, int] = {}  # epoch in which the surface last changed
        self._stale: set[TileIndex] = set()  # those that do not show the current surface
        self._indices = np.zeros((0, 3), np.int64)  # of ``changed``

    def clean(self, index: TileIndex) -> CachedTile | None:
        """Return the tile if it shows the current surface; None if it has to be made."""
        return None if index in self._stale else self.tiles.get(index)

    def touch(self, index: TileIndex, epoch: int) -> None:
        """Record that the surface of a tile changed in ``epoch``."""
        self.changed[index] = max(epoch, self.changed.get(index, 0))
        self._stale.add(index)

    def put(self, tile: CachedTile) -> None:
        """Keep a tile that was made."""
        self.tiles[tile.index] = tile
        if self.changed.get(tile.index, 0) <= tile.made:
            self._stale.discard(tile.index)

    def record(self, changes: Changes, half_m: float, epoch: int) -> None:
        """Record what changed in ``epoch``; voxels have sides of twice ``half_m``."""
        low, high = changes.places - half_m, changes.places + half_m
        touched = [
            *self.lattice.tiles_meeting(low, high, self.lattice.margin_m).tolist(),
            *self.lattice.tiles_meeting(changes.drifted, changes.drifted).tolist(),
        ]
        known = len(self.changed)
        for x, y, z in touched:
            self.touch((x, y, z), epoch)
        if len(self.changed) > known:
            self._indices = np.array(list(self.changed), np.int64)

    def delta(
        self,
        low: Doubles,
        high: Doubles,
        known_to: int,
        known: Mapping[TileIndex, int],
        revision: int,
    ) -> TileDelta:
        """Return :meth:`TileCache.delta`; ``revision`` is that of the newest tile of any level."""
        if known_to == revision and not known and not self._stale:
            # Nearly always so: not to look through all tiles, which may be many.
            return TileDelta([], [], [], outdated=[], revision=revision, known_to=revision)
        ready: list[CachedTile] = []
        missing: list[TileIndex] = []
        outdated: list[TileIndex] = []
        lacked_from = revision + 1  # the least revision that is lacked and made again
        inside = self._indices[self.lattice.meets(self._indices, low, high)]
        for x, y, z in inside.tolist():
            index = (x, y, z)
            tile = self.tiles.get(index)
            if tile is None:
                missing.append(index)
                continue
            unknown = tile.revision > known_to and known.get(index) != tile.version
            if self.clean(index) is None:
                outdated.append(index)
                if unknown:  # if it turns out to be as it was, it keeps its revision
                    lacked_from = min(lacked_from, tile.revision)
            elif unknown and (not tile.empty or known_to or index in known):
                ready.append(tile)
        ready.sort(key=lambda tile: tile.revision)
        outdated.sort(key=lambda index: (self.tiles[index].made, index))
        removed = [index for index in known if index not in self.changed]
        return TileDelta(
            ready,
            removed,
            sorted(missing),
            outdated=outdated,
            revision=revision,
            known_to=lacked_from - 1,
        )

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
