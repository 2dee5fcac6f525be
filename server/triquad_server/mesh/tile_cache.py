"""The mesh tiles of a map as they travel: made once, and the same bytes for everybody."""

import hashlib
import threading
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import encode_tile
from triquad_map.compiled.team import Team
from triquad_map.composition.composed_view import ComposedView

from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.mesher import TileIndex, mesh_tile
from triquad_server.mesh.surface_changes import SurfaceChanges
from triquad_server.mesh.tile_border import TileBorder
from triquad_server.mesh.tile_bytes import TileBytes
from triquad_server.mesh.tile_lattice import TileLattice, tile_lattice
from triquad_server.mesh.tile_level import CachedTile, TileDelta, TileLevel
from triquad_server.settings import MeshSettings


class TileCache:
    """Makes tiles when they are asked for, and keeps them until their surface changes.

    One thread makes tiles and asks for what is new; any thread may ask what changed.
    """

    def __init__(self, settings: MeshSettings, team: Team) -> None:
        """``team`` shares the work of making tiles."""
        self._lock = threading.Lock()
        self._team = team
        self._settings = settings
        self._levels = [TileLevel(tile_lattice(settings, level)) for level in range(LEVELS)]
        self._changes: SurfaceChanges | None = None
        self._epoch: Epoch | None = None
        self._view: ComposedView | None = None  # of that epoch
        self._revision = 0
        self._made = 0
        self._bytes = TileBytes(settings.cache_bytes)

    @property
    def epoch(self) -> int:
        """Number of the epoch of the last refresh; -1 before any."""
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
        return self._bytes.size

    def lattice(self, level: int) -> TileLattice:
        """Where the tiles of a level lie."""
        return self._levels[level].lattice

    def refresh(self, epoch: Epoch) -> None:
        """Find out what changed until ``epoch``; one older than the last changes nothing."""
        with self._lock:
            if epoch.number <= self.epoch:
                return
            if self._changes is None:
                self._changes = SurfaceChanges(
                    epoch.field_settings,
                    self._settings.tolerance_m,
                    self._settings.tile_side_m,
                    self._team,
                )
            changes = self._changes.since_last(epoch.frozen_regions)
            for level in self._levels:
                level.record(changes, epoch.field_settings.leaf_m / 2, epoch.number)
            self._epoch = epoch
            # The threads that answer queries are spared: these give way to them.
            self._view = ComposedView(
                epoch.number, epoch.field_settings, epoch.frozen_regions, self._team.split
            )

    def changed(self, level: int, indices: NDArray[np.integer]) -> NDArray[np.int64]:
        """Epochs [T] in which the surface of tiles [T, 3] last changed; 0 where none was seen."""
        with self._lock:
            tiles = self._levels[level]
            epochs = [tiles.changed((x, y, z)) for x, y, z in indices.tolist()]
        return np.array(epochs, np.int64)

    def delta(
        self,
        level: int,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        known_to: int,
        held: Mapping[TileIndex, int],
    ) -> TileDelta:
        """What is new in a box to somebody who knows everything up to the revision ``known_to``.

        ``held`` are versions of tiles that are known whatever the revision.
        """
        with self._lock:
            return self._levels[level].delta(
                low, high, known_to=known_to, held=held, revision=self._revision
            )

    def make(self, level: int, index: TileIndex) -> CachedTile:
        """Make a tile from the epoch of the last refresh, to fit its neighbours."""
        view = self._view
        assert view is not None, "refresh comes first"
        tiles = self._levels[level]
        with self._lock:
            borders = tiles.borders_around(index)
        around = TileBorder.joined(self._agreeing(tiles, index, borders, view))
        mesh = mesh_tile(view, index, tiles.lattice, around)
        data = encode_tile(mesh.surface)
        digest = hashlib.sha256(data).digest()
        with self._lock:
            self._made += 1
            old = tiles.tile(index)
            if old is not None and old.digest == digest:
                version, revision = old.version, old.revision
            else:
                self._revision += 1
                version, revision = view.epoch, self._revision
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
        """The bytes of a tile, None where they are gone; it has to be made anew then."""
        with self._lock:
            return self._bytes.get((level, tile.index))

    def _agreeing(
        self,
        tiles: TileLevel,
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
            neighbour = tiles.tile(other)
            outdated = neighbour is not None and neighbour.made < view.epoch and other != index
            if len(places) and outdated:
                moved = np.abs(view.distances(places) - border.values[near])
                if 2 * np.count_nonzero(moved > self._settings.tolerance_m) > len(moved):
                    with self._lock:
                        tiles.invalidate(other, view.epoch)
                    continue
            yield border
