"""The mesh tiles of a map as they travel: made once, and the same bytes for everybody."""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import encode_tile
from triquad_map.compiled.mesh.mesher import mesh_tile
from triquad_map.compiled.mesh.tile_border import TileBorder
from triquad_map.compiled.mesh.tile_lattice import TileIndex, TileLattice
from triquad_map.compiled.team import THREADS, Team
from triquad_map.composition.composed_view import ComposedView

from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.answered_tiles import AnsweredTiles
from triquad_server.mesh.surface_changes import Changes, SurfaceChanges
from triquad_server.settings import MeshSettings

_AROUND = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]

_ANSWERED_BYTES = 8_000_000
"""Of tiles of one epoch that somebody asked for by name: some 230 m of street."""

TileKey = tuple[int, TileIndex]
"""Level of detail and index of a tile."""


def tile_lattice(settings: MeshSettings, level: int) -> TileLattice:
    """The lattice of a level of detail, ``0 <= level < LEVELS``."""
    finest = TileLattice(settings.cell_m, settings.tile_cells, settings.reach_m)
    return finest.at_level(level)


class TileBytes:
    """Encoded tiles in memory; those unused for longest are dropped where there are too many."""

    def __init__(self, limit: int) -> None:
        """Keep at most ``limit`` bytes, or a single tile that is larger."""
        self._limit = limit
        self.size = 0  # bytes of the tiles that are kept
        self._data: OrderedDict[TileKey, bytes] = OrderedDict()  # longest unused first

    def get(self, key: TileKey) -> bytes | None:
        """The bytes of a tile, None where they are gone."""
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
    missing: list[TileIndex]  # that were never made
    outdated: list[TileIndex]  # that have to be made anew, those made longest ago first
    revision: int  # who knows all of this knows everything up to here

    @property
    def to_make(self) -> list[TileIndex]:
        """All that have to be made, the most needed first."""
        return self.missing + self.outdated


class _TileLevel:
    """The tiles of one level of detail: which there are, and which of them are out of date."""

    def __init__(self, lattice: TileLattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, CachedTile] = {}  # as they were last made
        self.changed: dict[TileIndex, int] = {}  # epoch in which the surface last changed
        self._indices = np.zeros((0, 3), np.int64)  # of ``changed``

    def clean(self, index: TileIndex) -> CachedTile | None:
        """The tile where it shows what the map has; None where it has to be made."""
        tile = self.tiles.get(index)
        return tile if tile is not None and self.changed.get(index, 0) <= tile.made else None

    def record(self, changes: Changes, half_m: float, epoch: int) -> None:
        """Record what changed in ``epoch``; voxels have sides of twice ``half_m``."""
        low, high = changes.places - half_m, changes.places + half_m
        touched = [
            *self.lattice.tiles_meeting(low, high, self.lattice.margin_m).tolist(),
            *self.lattice.tiles_meeting(changes.drifted, changes.drifted).tolist(),
        ]
        known = len(self.changed)
        for x, y, z in touched:
            self.changed[x, y, z] = epoch
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
        """As :meth:`TileCache.delta`; ``revision`` is that of the newest tile of any level."""
        ready: list[CachedTile] = []
        missing: list[TileIndex] = []
        outdated: list[TileIndex] = []
        inside = self._indices[self.lattice.meets(self._indices, low, high)]
        for x, y, z in inside.tolist():
            index = (x, y, z)
            tile = self.clean(index)
            if tile is None:
                (outdated if index in self.tiles else missing).append(index)
                continue
            unknown = tile.revision > known_to and known.get(index) != tile.version
            if unknown and (not tile.empty or known_to or index in known):
                ready.append(tile)
        ready.sort(key=lambda tile: tile.revision)
        outdated.sort(key=lambda index: (self.tiles[index].made, index))
        removed = [index for index in known if index not in self.changed]
        return TileDelta(ready, removed, sorted(missing), outdated=outdated, revision=revision)

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


def _touch(first: TileIndex, second: TileIndex) -> bool:
    return all(abs(a - b) <= 1 for a, b in zip(first, second, strict=True))


class TileCache:
    """Makes tiles when they are asked for, and keeps them until their surface changes.

    One thread has tiles made and asks for what is new; any thread may ask what changed.
    """

    def __init__(self, settings: MeshSettings, team: Team) -> None:
        """``team`` shares the work of making tiles."""
        self._lock = threading.Lock()
        self._team = team
        self._settings = settings
        self._levels = [_TileLevel(tile_lattice(settings, level)) for level in range(LEVELS)]
        self._changes: SurfaceChanges | None = None
        self.epoch = -1  # number of that of the last refresh
        self._view: ComposedView | None = None  # of which tiles are made
        self.revision = 0  # how often bytes of any tile came to differ
        self.tiles_made = 0  # so far
        self._bytes = TileBytes(settings.cache_bytes)
        # Those that are asked for by name.
        self.answered = AnsweredTiles(min(_ANSWERED_BYTES, settings.cache_bytes))

    @property
    def made_from(self) -> int:
        """Number of the epoch from which tiles are made; -1: of none, after :meth:`let_go`."""
        view = self._view
        return -1 if view is None else view.epoch

    @property
    def nbytes(self) -> int:
        """Bytes of the encoded tiles that are kept."""
        return self._bytes.size + self.answered.nbytes

    def lattice(self, level: int) -> TileLattice:
        """Where the tiles of a level lie."""
        return self._levels[level].lattice

    def refresh(self, epoch: Epoch, *, to_make: bool = True) -> None:
        """Find out what changed until ``epoch``; one older than the last changes nothing.

        Tiles are made from it from now on, but for where none are made and none are to be
        (``to_make``).
        """
        with self._lock:
            if epoch.number > self.epoch:
                self._record_changes(epoch)
            if epoch.number == self.epoch and (to_make or self._view is not None):
                self._view = epoch.asked_with()

    def let_go(self) -> None:
        """Hold no epoch for tiles to be made from, until the next refresh: it takes memory."""
        with self._lock:
            self._view = None

    def changed(self, level: int, indices: NDArray[np.integer]) -> Longs:
        """Epochs [T] in which the surface of tiles [T, 3] last changed; 0 where none was seen."""
        with self._lock:
            tiles = self._levels[level]
            epochs = [tiles.changed.get((x, y, z), 0) for x, y, z in indices.tolist()]
        return np.array(epochs, np.int64)

    def delta(
        self, level: int, low: Doubles, high: Doubles, known_to: int, known: Mapping[TileIndex, int]
    ) -> TileDelta:
        """What is new in a box to somebody who knows everything up to the revision ``known_to``.

        The box has the corners ``low`` and ``high`` [3], metres, map frame; ``known`` are versions
        of tiles that are known whatever the revision.
        """
        with self._lock:
            return self._levels[level].delta(
                low, high, known_to=known_to, known=known, revision=self.revision
            )

    def make_some(self, level: int, indices: Iterable[TileIndex]) -> list[TileIndex]:
        """Make some tiles at the same time, one on each core, the first of ``indices`` among them.

        No two of them touch, so that none has to fit another that is not made yet.
        """
        chosen: list[TileIndex] = []
        for index in indices:
            if not any(_touch(index, other) for other in chosen):
                chosen.append(index)
            if len(chosen) == THREADS:
                break

        def work(first: int, last: int) -> None:
            for index in chosen[first:last]:
                self.make(level, index)

        self._team.split(len(chosen), work, least=1)
        return chosen

    def make(self, level: int, index: TileIndex) -> CachedTile:
        """Make a tile from the epoch of the last refresh, to fit its neighbours."""
        view = self._view
        assert view is not None, "refresh comes first"
        tiles = self._levels[level]
        with self._lock:
            borders = tiles.borders_around(index)
        around = TileBorder.joined(self._agreeing(tiles, index, borders=borders, view=view))
        mesh = mesh_tile(view, index, tiles.lattice, around=around)
        data = encode_tile(mesh.surface)
        digest = hashlib.sha256(data).digest()
        with self._lock:
            self.tiles_made += 1
            old = tiles.tiles.get(index)
            if old is not None and old.digest == digest:
                version, revision = old.version, old.revision
            else:
                self.revision += 1
                version, revision = view.epoch, self.revision
            tile = CachedTile(
                index=index,
                version=version,
                revision=revision,
                made=view.epoch,
                empty=len(mesh.faces) == 0,
                digest=digest,
                border=mesh.border,
            )
            tiles.tiles[index] = tile
            self._bytes.put((level, index), data)
        return tile

    def data(self, level: int, tile: CachedTile) -> bytes | None:
        """The bytes of a tile, None where they are gone; it has to be made anew then."""
        with self._lock:
            return self._bytes.get((level, tile.index))

    def _record_changes(self, epoch: Epoch) -> None:
        if self._changes is None:
            self._changes = SurfaceChanges(
                epoch.field_settings,
                tolerance_m=self._settings.tolerance_m,
                group_m=self.lattice(0).tile_side_m,
                team=self._team,
            )
        changes = self._changes.since_last(epoch.frozen_regions)
        for level in self._levels:
            level.record(changes, epoch.field_settings.leaf_m / 2, epoch.number)
        self.epoch = epoch.number

    def _agreeing(
        self,
        tiles: _TileLevel,
        index: TileIndex,
        borders: Mapping[TileIndex, TileBorder],
        view: ComposedView,
    ) -> Iterator[TileBorder]:
        """The borders to be taken over; tiles of others will have to be made again.

        Those are others whose surface is no longer where it was: else two tiles in turns could
        hold on to what neither has any more.
        """
        lattice = tiles.lattice
        corner = np.asarray(index) * lattice.cells
        for other, border in borders.items():
            near = np.abs(border.values) < lattice.cell_m
            places = (border.points[near] + corner) * lattice.cell_m
            neighbour = tiles.tiles.get(other)
            outdated = neighbour is not None and neighbour.made < view.epoch and other != index
            if len(places) and outdated:
                moved = np.abs(view.distances(places) - border.values[near])
                if 2 * np.count_nonzero(moved > self._settings.tolerance_m) > len(moved):
                    with self._lock:
                        tiles.changed[other] = max(tiles.changed[other], view.epoch)
                    continue
            yield border
