"""Caches the mesh tiles of a map in transmitted form: made once, and the same for all clients."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import encode_tile
from triquad_map.compiled.team import THREADS, Team
from triquad_map.composition.composed_view import ComposedView
from triquad_map.mesh.tile_mesh import TileBorder, TileIndex, TileLattice, TileMesh, mesh_tile

from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.surface_changes import SurfaceChanges
from triquad_server.mesh.tile_level import CachedTile, TileLevel
from triquad_server.settings import MeshSettings

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

    def __init__(self, limit: Callable[[], int]) -> None:
        """Keep at most ``limit()`` bytes, or a single tile that is larger."""
        self._limit = limit
        self.size = 0  # bytes of the tiles that are kept
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
        self.size += tile.nbytes - (0 if before is None else before.nbytes)
        self._tiles[key] = tile
        while self.size > self._limit() and len(self._tiles) > 1:
            _, dropped = self._tiles.popitem(last=False)
            self.size -= dropped.nbytes


def tile_lattice(settings: MeshSettings, level: int) -> TileLattice:
    """Return the lattice of a level of detail, ``0 <= level < LEVELS``."""
    finest = TileLattice(settings.cell_m, settings.tile_cells, settings.reach_m)
    return finest.at_level(level)


def _shown(mesh: TileMesh, view: ComposedView, *, marked: bool) -> ShownTile:
    filled = mesh.filled if marked else mesh.filled[:0]
    return ShownTile(view.epoch, encode_tile(mesh.surface), filled.astype(np.uint8))


def _touch(first: TileIndex, second: TileIndex) -> bool:
    return all(abs(a - b) <= 1 for a, b in zip(first, second, strict=True))


class TileCache:
    """Makes tiles when they are requested, and keeps them.

    Tiles that are followed are kept until their surface changes. They fit their neighbours, though
    these may be of other epochs. One thread uses the cache, and shares the making of tiles with its
    team.
    """

    def __init__(
        self, settings: MeshSettings, team: Team, max_bytes: Callable[[], int] = lambda: 2**40
    ) -> None:
        """Begin with no tiles, of which ``max_bytes()`` are kept; ``team`` shares the work."""
        self._lock = threading.Lock()
        self._team = team
        self._settings = settings
        self._levels = [TileLevel(tile_lattice(settings, level)) for level in range(LEVELS)]
        self._changes: SurfaceChanges | None = None
        self.epoch = -1  # number of the epoch of the last refresh
        self._view: ComposedView | None = None  # epoch from which tiles are made
        self._shown = ShownTiles(lambda: min(settings.cache_bytes, max_bytes()))

    @property
    def nbytes(self) -> int:
        """The bytes of the tiles that are kept in transmitted form, and of the borders of all."""
        return self._shown.size + sum(level.nbytes for level in self._levels)

    def lattice(self, level: int) -> TileLattice:
        """Return where the tiles of a level lie."""
        return self._levels[level].lattice

    def refresh(self, epoch: Epoch) -> None:
        """Find what changed until ``epoch``, of which tiles are made from now on.

        One older than the last changes nothing.
        """
        with self._lock:
            if epoch.number > self.epoch:
                self._record_changes(epoch)
                self._view = epoch.in_one_thread()

    def changed(self, level: int, low: Doubles, high: Doubles, since: int) -> dict[TileIndex, int]:
        """Return :meth:`TileLevel.changed_since` of a level, as of the last refresh."""
        with self._lock:
            return self._levels[level].changed_since(low, high, since)

    def revision(self, level: int) -> int:
        """Return the number of the newest change of a level, for :meth:`changed`."""
        with self._lock:
            return self._levels[level].revision

    def kept(self, level: int, index: TileIndex) -> ShownTile | None:
        """Return a tile that shows the current surface; None if it has to be made, or made again.

        It has to be made again if its bytes were dropped.
        """
        with self._lock:
            shown = self._shown.get(TileKey(level, index))
            return None if self._levels[level].clean(index) is None else shown

    def of_epoch(
        self, view: ComposedView, level: int, indices: Sequence[TileIndex], fill_m: float
    ) -> list[ShownTile]:
        """Return tiles that are all of one epoch; those that are not kept are made in parallel.

        Holes up to ``fill_m`` are filled. The view splits nothing: there are tiles for all cores.
        """
        found: dict[TileIndex, ShownTile] = {}

        def work(first: int, last: int) -> None:
            for index in indices[first:last]:
                key = TileKey(level, index, view.epoch, fill_m)
                with self._lock:
                    kept = self._shown.get(key)
                if kept is None:
                    mesh = mesh_tile(view, index, self.lattice(level), fill_m=fill_m)
                    kept = _shown(mesh, view, marked=fill_m > 0)
                    with self._lock:
                        self._shown.put(key, kept)
                found[index] = kept

        self._team.split(len(indices), work, least=1)
        return [found[index] for index in indices]

    def make_some(self, level: int, indices: Iterable[TileIndex]) -> dict[TileIndex, ShownTile]:
        """Make some tiles in parallel, one on each core, including the first of ``indices``.

        No two of them touch, so that none has to fit another that is not made yet.
        """
        chosen: list[TileIndex] = []
        for index in indices:
            if not any(_touch(index, other) for other in chosen):
                chosen.append(index)
            if len(chosen) == THREADS:
                break
        made: dict[TileIndex, ShownTile] = {}

        def work(first: int, last: int) -> None:
            for index in chosen[first:last]:
                made[index] = self.make(level, index)

        self._team.split(len(chosen), work, least=1)
        return made

    def make(self, level: int, index: TileIndex) -> ShownTile:
        """Make a tile from the epoch of the last refresh, to fit its neighbours."""
        view = self._view
        assert view is not None, "refresh comes first"
        tiles = self._levels[level]
        with self._lock:
            borders = tiles.borders_around(index)
        around = TileBorder.joined(self._agreeing(tiles, index, borders=borders, view=view))
        mesh = mesh_tile(view, index, tiles.lattice, around=around)
        shown = _shown(mesh, view, marked=False)
        with self._lock:
            tiles.put(index, CachedTile(view.epoch, len(mesh.faces) == 0, mesh.border))
            self._shown.put(TileKey(level, index), shown)
        return shown

    def _record_changes(self, epoch: Epoch) -> None:
        if self._changes is None:
            self._changes = SurfaceChanges(
                epoch.field_settings,
                tolerance_m=self._settings.tolerance_m,
                group_m=self.lattice(0).tile_side_m,
                team=self._team,
            )
        for changes in self._changes.since_last(epoch.frozen_regions):
            for level in self._levels:
                level.record(changes, epoch.field_settings.leaf_m / 2, epoch.number)
        self.epoch = epoch.number

    def _agreeing(
        self,
        tiles: TileLevel,
        index: TileIndex,
        borders: Mapping[TileIndex, TileBorder],
        view: ComposedView,
    ) -> Iterator[TileBorder]:
        """Yield the borders to be taken over; tiles of others will have to be made again.

        Those are others whose surface has moved: else two tiles in turns could
        keep what neither has any more.
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
                        tiles.touch(other, view.epoch)
                    continue
            yield border
