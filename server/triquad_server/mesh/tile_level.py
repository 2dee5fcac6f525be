"""The tiles of a level of detail, and which of them are out of date."""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_map.mesh.tile_mesh import TileBorder, TileIndex, TileLattice

from triquad_server.mesh.surface_changes import Changes

_AROUND = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]


@dataclass(frozen=True)
class CachedTile:
    """A tile that was made; its bytes may be dropped, what neighbours need of it never is."""

    made: int  # epoch of which it is
    empty: bool  # without faces
    border: TileBorder


class TileChange(NamedTuple):
    """When the surface of a tile changed last."""

    epoch: int
    revision: int  # its number among all changes of the level: there are several in an epoch


_NEVER = TileChange(0, 0)


class TileLevel:
    """Keeps the tiles of one level of detail, and when the surface of each changed."""

    def __init__(self, lattice: TileLattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, CachedTile] = {}  # as they were last made
        self.nbytes = 0  # of their borders
        self.changed: dict[TileIndex, TileChange] = {}  # the last one of each
        self.revision = 0  # number of the newest change

    def clean(self, index: TileIndex) -> CachedTile | None:
        """Return the tile if it shows the current surface; None if it has to be made."""
        tile = self.tiles.get(index)
        return None if tile is None or tile.made < self.changed.get(index, _NEVER).epoch else tile

    def put(self, index: TileIndex, tile: CachedTile) -> None:
        """Keep a tile that was made."""
        self._drop(index)
        self.tiles[index] = tile
        self.nbytes += tile.border.nbytes

    def _drop(self, index: TileIndex) -> None:
        tile = self.tiles.pop(index, None)
        self.nbytes -= 0 if tile is None else tile.border.nbytes

    def touch(self, index: TileIndex, epoch: int) -> None:
        """Record that the surface of a tile changed in ``epoch``."""
        self.changed.pop(index, None)
        self._drop(index)
        self.revision += 1
        self.changed[index] = TileChange(epoch, self.revision)  # the newest is last

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
        """Return the epoch in which the surface of each tile changed, after revision ``since``.

        They meet a box with the corners ``low`` and ``high`` [3], metres, map frame. Since 0,
        those that are known to have no faces are left out.
        """
        newest_first = itertools.takewhile(
            lambda index: self.changed[index].revision > since, reversed(self.changed)
        )
        found = [index for index in newest_first if since or not self._is_empty(index)]
        inside = self.lattice.meets(np.array(found, np.int64).reshape(-1, 3), low, high)
        return {index: self.changed[index].epoch for index in itertools.compress(found, inside)}

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
