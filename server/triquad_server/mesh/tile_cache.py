"""Caches the mesh tiles of a map in transmitted form: made once, and the same for all clients."""

import hashlib
import threading
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import encode_tile
from triquad_map.compiled.team import THREADS, Team
from triquad_map.composition.composed_view import ComposedView
from triquad_map.mesh.mesher import mesh_tile
from triquad_map.mesh.tile_lattice import TileBorder, TileIndex, TileLattice

from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.answered_tiles import AnsweredTiles
from triquad_server.mesh.surface_changes import SurfaceChanges
from triquad_server.mesh.tile_level import CachedTile, TileBytes, TileDelta, TileLevel
from triquad_server.settings import MeshSettings


def tile_lattice(settings: MeshSettings, level: int) -> TileLattice:
    """Return the lattice of a level of detail, ``0 <= level < LEVELS``."""
    finest = TileLattice(settings.cell_m, settings.tile_cells, settings.reach_m)
    return finest.at_level(level)


def _touch(first: TileIndex, second: TileIndex) -> bool:
    return all(abs(a - b) <= 1 for a, b in zip(first, second, strict=True))


class TileCache:
    """Makes tiles when they are requested, and keeps them until their surface changes.

    One thread has tiles made and requests what is new; any thread may ask what changed.
    """

    def __init__(self, settings: MeshSettings, team: Team) -> None:
        """Begin with no tiles; ``team`` shares the work of making tiles."""
        self._lock = threading.Lock()
        self._team = team
        self._settings = settings
        self._levels = [TileLevel(tile_lattice(settings, level)) for level in range(LEVELS)]
        self._changes: SurfaceChanges | None = None
        self.epoch = -1  # number of the epoch of the last refresh
        self._view: ComposedView | None = None  # epoch from which tiles are made
        self.revision = 0  # number of times that bytes of any tile came to differ
        self._bytes = TileBytes(settings.cache_bytes)
        self.answered = AnsweredTiles()  # those of queries, which need not fit their neighbours

    @property
    def nbytes(self) -> int:
        """Return the bytes of the encoded tiles that are kept."""
        return self._bytes.size + self.answered.nbytes

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
                self._view = epoch.with_split()

    def changed(self, level: int, indices: NDArray[np.integer]) -> Longs:
        """Return the epochs [T] when the surface of tiles [T, 3] last changed; 0: none was seen."""
        with self._lock:
            tiles = self._levels[level]
            epochs = [tiles.changed.get((x, y, z), 0) for x, y, z in indices.tolist()]
        return np.array(epochs, np.int64)

    def delta(
        self, level: int, low: Doubles, high: Doubles, known_to: int, known: Mapping[TileIndex, int]
    ) -> TileDelta:
        """Return what is new in a box to a client that knows all up to revision ``known_to``.

        The box has the corners ``low`` and ``high`` [3], metres, map frame; ``known`` are versions
        of tiles that are known whatever the revision.
        """
        with self._lock:
            return self._levels[level].delta(
                low, high, known_to=known_to, known=known, revision=self.revision
            )

    def make_some(self, level: int, indices: Iterable[TileIndex]) -> list[TileIndex]:
        """Make some tiles in parallel, one on each core, including the first of ``indices``.

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
            tiles.put(tile)
            self._bytes.put((level, index), data)
        return tile

    def data(self, level: int, tile: CachedTile) -> bytes | None:
        """Return the bytes of a tile; None if they were dropped, and it has to be made again."""
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
