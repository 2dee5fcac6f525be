"""The mesh tiles of a map as they travel: made once, and the same bytes for everybody."""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.wire.tile_codec import encode_tile
from triquad_map.compiled.compiled_view import CompiledView
from triquad_map.compiled.team import Team

from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.mesher import TileIndex, mesh_tile
from triquad_server.mesh.surface_changes import Changes, SurfaceChanges
from triquad_server.mesh.tile_border import TileBorder
from triquad_server.mesh.tile_lattice import LEVELS, TileLattice, tile_lattice, tiles_meeting
from triquad_server.settings import MeshSettings
from triquad_server.threads import PATIENCE

MESHING = Team("triquad-meshing", PATIENCE)
"""For tiles that nobody waits for at the moment."""

_AROUND = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]


@dataclass(frozen=True)
class ShelvedTile:
    """A tile that was made. Its bytes may be gone; what neighbours need of it never is."""

    index: TileIndex
    version: int  # epoch of which its bytes are
    revision: int  # its place in the order in which bytes came to differ
    made: int  # epoch with which it was last found to agree
    empty: bool  # without faces
    digest: bytes
    border: TileBorder


@dataclass(frozen=True)
class TileNews:
    """What somebody does not know of the tiles of a box."""

    ready: list[ShelvedTile]  # by increasing revision; empty ones are to be removed
    removed: list[TileIndex]  # that are held, and were never here
    to_make: list[TileIndex]  # those that changed first come first
    revision: int  # who knows all of this knows everything up to here


class _Level:
    """The tiles of one level of detail."""

    def __init__(self, lattice: TileLattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, ShelvedTile] = {}
        self.changed: dict[TileIndex, int] = {}  # epoch in which the surface last changed
        self._indices = np.zeros((0, 3), np.int64)  # of ``changed``

    def clean(self, index: TileIndex) -> ShelvedTile | None:
        """The tile where it shows what the map has; None where it has to be made."""
        tile = self.tiles.get(index)
        return tile if tile is not None and self.changed.get(index, 0) <= tile.made else None

    def touch(self, changes: Changes, half_m: float, epoch: int) -> None:
        """Note what changed; voxels have sides of twice ``half_m``."""
        low, high = changes.places - half_m, changes.places + half_m
        touched = [
            *tiles_meeting(low, high, self.lattice.margin_m, self.lattice).tolist(),
            *tiles_meeting(changes.drifted, changes.drifted, 0.0, self.lattice).tolist(),
        ]
        known = len(self.changed)
        for x, y, z in touched:
            self.changed[x, y, z] = epoch
        if len(self.changed) > known:
            self._indices = np.array(list(self.changed), np.int64)

    def within(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> list[TileIndex]:
        """Tiles that meet the box between two corners [3] and ever had a surface near."""
        corners = self._indices * self.lattice.tile_side_m
        meets = ((corners <= high) & (corners + self.lattice.tile_side_m >= low)).all(axis=1)
        return [(x, y, z) for x, y, z in self._indices[meets].tolist()]


class TileShelf:
    """Makes tiles when they are asked for, and keeps them until their surface changes.

    One thread makes tiles and looks for news; any thread may ask what changed.
    """

    def __init__(self, settings: MeshSettings) -> None:
        self._lock = threading.Lock()
        self._settings = settings
        self._levels = [_Level(tile_lattice(settings, level)) for level in range(LEVELS)]
        self._changes: SurfaceChanges | None = None
        self._epoch: Epoch | None = None
        self._view: CompiledView | None = None  # of that epoch
        self._revision = 0
        self._made = 0
        self._data: OrderedDict[tuple[int, TileIndex], bytes] = (
            OrderedDict()
        )  # longest unused first
        self._bytes = 0

    @property
    def epoch(self) -> int:
        """Number of the epoch that was looked at last; -1 before any."""
        return -1 if self._epoch is None else self._epoch.number

    @property
    def revision(self) -> int:
        """How often bytes of any tile came to differ."""
        return self._revision

    @property
    def tiles_made(self) -> int:
        """How many tiles were meshed so far."""
        return self._made

    @property
    def size(self) -> int:
        """Bytes of the encoded tiles that are kept."""
        return self._bytes

    def lattice(self, level: int) -> TileLattice:
        """Where the tiles of a level lie."""
        return self._levels[level].lattice

    def look(self, epoch: Epoch) -> None:
        """Find out what changed until ``epoch``; an older one than the last tells nothing."""
        with self._lock:
            if epoch.number <= self.epoch:
                return
            if self._changes is None:
                self._changes = SurfaceChanges(
                    epoch.field_settings,
                    self._settings.tolerance_m,
                    self._settings.tile_side_m,
                    MESHING,
                )
            changes = self._changes.since_last(epoch.frozen_regions)
            for level in self._levels:
                level.touch(changes, epoch.field_settings.leaf_m / 2, epoch.number)
            self._epoch = epoch
            # Its work is shared by threads that are patient.
            self._view = CompiledView(
                epoch.number, epoch.field_settings, epoch.frozen_regions, MESHING.split
            )

    def changed(self, level: int, indices: NDArray[np.integer]) -> NDArray[np.int64]:
        """Epochs [T] in which the surface of tiles [T, 3] last changed; 0 where none was seen."""
        with self._lock:
            changed = self._levels[level].changed
            epochs = [changed.get((x, y, z), 0) for x, y, z in indices.tolist()]
        return np.array(epochs, np.int64)

    def news(
        self,
        level: int,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        revision: int,
        held: Mapping[TileIndex, int],
    ) -> TileNews:
        """What is new in a box to somebody who knows everything up to a revision.

        ``held`` are versions of tiles that are known whatever the revision.
        """
        with self._lock:
            shelf = self._levels[level]
            ready: list[ShelvedTile] = []
            removed = [index for index in held if index not in shelf.changed]
            to_make: list[TileIndex] = []
            for index in shelf.within(low, high):
                tile = shelf.clean(index)
                if tile is None:
                    to_make.append(index)
                    continue
                unknown = tile.revision > revision and held.get(index) != tile.version
                if unknown and (not tile.empty or revision or index in held):
                    ready.append(tile)
            ready.sort(key=lambda tile: tile.revision)
            to_make.sort(key=lambda index: (shelf.changed[index], index))
            return TileNews(ready, removed, to_make, self._revision)

    def make(self, level: int, index: TileIndex) -> ShelvedTile:
        """Make a tile from the epoch that was looked at last, to fit its neighbours."""
        view = self._view
        assert view is not None, "nothing was looked at"
        shelf = self._levels[level]
        with self._lock:
            borders = _borders_around(shelf, index)
        around = TileBorder.joined(self._agreeing(shelf, index, borders, view))
        mesh = mesh_tile(view, index, shelf.lattice, around)
        data = encode_tile(mesh.surface)
        digest = hashlib.sha256(data).digest()
        with self._lock:
            self._made += 1
            old = shelf.tiles.get(index)
            if old is not None and old.digest == digest:
                version, revision = old.version, old.revision
            else:
                self._revision += 1
                version, revision = view.epoch, self._revision
            tile = ShelvedTile(
                index, version, revision, view.epoch, len(mesh.faces) == 0, digest, mesh.border
            )
            shelf.tiles[index] = tile
            self._keep((level, index), data)
        return tile

    def _agreeing(
        self,
        shelf: _Level,
        index: TileIndex,
        borders: dict[TileIndex, TileBorder],
        view: CompiledView,
    ) -> Iterator[TileBorder]:
        """The borders to be taken over; tiles of others will have to be made again.

        Those are others whose surface is no longer where it was: else two tiles in turns could
        hold on to what neither has any more.
        """
        lattice = shelf.lattice
        corner = np.asarray(index) * lattice.cells
        for other, border in borders.items():
            near = np.abs(border.values) < lattice.cell_m
            places = (border.points[near] + corner) * lattice.cell_m
            if len(places) and shelf.tiles[other].made < view.epoch and other != index:
                moved = np.abs(view.distances(places) - border.values[near])
                if 2 * np.count_nonzero(moved > self._settings.tolerance_m) > len(moved):
                    with self._lock:
                        shelf.changed[other] = max(shelf.changed[other], view.epoch)
                    continue
            yield border

    def data(self, level: int, tile: ShelvedTile) -> bytes | None:
        """The bytes of a tile, None where they are gone; it has to be made anew then."""
        with self._lock:
            data = self._data.get((level, tile.index))
            if data is not None:
                self._data.move_to_end((level, tile.index))
            return data

    def _keep(self, key: tuple[int, TileIndex], data: bytes) -> None:
        """Keep bytes; those unused for longest go where there are too many."""
        self._bytes += len(data) - len(self._data.pop(key, b""))
        self._data[key] = data
        while self._bytes > self._settings.shelf_bytes and len(self._data) > 1:
            _, gone = self._data.popitem(last=False)
            self._bytes -= len(gone)


def _borders_around(shelf: _Level, index: TileIndex) -> dict[TileIndex, TileBorder]:
    """What a tile has to agree with, by the tiles whose it is, in its own lattice.

    That is its own border where only its bytes are gone, and those of all neighbours that show
    what the map has: these agree with each other. The others will be made to fit it.
    """
    found: dict[TileIndex, TileBorder] = {}
    own = shelf.clean(index)
    if own is not None:
        found[index] = own.border
    for offset in _AROUND:
        x, y, z = (a + b for a, b in zip(index, offset, strict=True))
        neighbour = shelf.clean((x, y, z))
        if neighbour is not None:
            found[x, y, z] = neighbour.border.seen_from(offset, shelf.lattice.cells)
    return found
