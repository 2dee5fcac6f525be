"""The map of a file, without a server."""

import threading
from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import OfflineMap
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import TileIndex
from triquad_client.offline.map_mesh import TILE_CELLS, MapTiles
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.viewer.sources.map_source import COARSEST, MapState, TileSizes
from triquad_tools.viewer.sources.tile_cache import MadeTile
from triquad_tools.viewer.sources.tile_maker import TileMaker

_CELL_LEAVES = 0.5  # of a cell of level 0, as in a server's mesh
_WAIT_S = 0.1


class FileSource:
    """A map in memory; it is closed by who opened it."""

    grows = False

    def __init__(self, opened: OfflineMap, path: Path, maker: TileMaker) -> None:
        """``path`` is the file that the map was read from."""
        self.opened = opened
        self.queries = opened
        self.title = f"{opened.name} in {path.name}"
        cell_m = _CELL_LEAVES * opened.leaf_m
        self.sizes = TileSizes(cell_m, TILE_CELLS * cell_m)
        self._maker = maker
        name = (path, opened.epoch, opened.stamp_ns)
        self._levels = [
            LevelTiles(opened, (*name, level), level=level, sizes=self.sizes)
            for level in range(COARSEST + 1)
        ]

    def state(self) -> MapState:
        """What the file holds."""
        stamp_ns = self.opened.stamp_ns
        time = utc_time(stamp_ns) if stamp_ns else ""
        return MapState(self.opened.name, self.opened.epoch, time)

    def follow(self, level: int, bounds: Bounds | None = None) -> "FileFollower":
        """The mesh tiles of a level that meet ``bounds``, as they are made here."""
        return FileFollower(self._maker, self._levels[level], bounds, made={})

    def prepare(self, timeout_s: float) -> None:
        """Make the coarsest tiles, or as many as can be in that time.

        Raises:
            TriquadError: they cannot be made.
        """
        follower = self.follow(COARSEST)
        follower.wait(timeout_s)
        follower.close()


class LevelTiles:
    """The tiles of one level of detail; for several threads."""

    def __init__(self, opened: OfflineMap, name: Hashable, *, level: int, sizes: TileSizes) -> None:
        self._opened = opened
        self.name = name
        """Of the tiles of no other level or map."""
        self.level = level
        self.side_m = sizes.side_of(level)
        self._cell_m = sizes.cell_of(level)
        self._tiles: MapTiles | None = None
        self._listing = threading.Lock()

    def listed(self) -> Collection[TileIndex]:
        """The tiles in which there may be faces."""
        return self._listed().indices

    def make(self, index: TileIndex) -> MadeTile:
        """One of these."""
        mesh = self._listed().mesh(index)
        origin = np.array(index) * self.side_m
        vertices = (mesh.vertices - origin).astype(np.float32)
        return MadeTile(self._opened.epoch, origin, vertices, faces=mesh.faces)

    def _listed(self) -> MapTiles:
        with self._listing:
            if self._tiles is None:
                self._tiles = self._opened.mesh_tiles(self._cell_m)
            return self._tiles


@dataclass(frozen=True)
class TilesInBox:
    """Chooses the tiles of a box, those nearest to its middle first."""

    bounds: Bounds | None  # metres, map frame; None: everywhere
    side_m: float

    def __call__(self, listed: Collection[TileIndex]) -> list[TileIndex]:
        """The tiles in their order."""
        tiles = np.array(list(listed), np.int64).reshape(-1, 3)
        corners = tiles * self.side_m
        if self.bounds is not None:
            low, high = np.asarray(self.bounds, np.float64)
            meets = ((corners <= high) & (corners + self.side_m >= low)).all(axis=1)
            tiles, corners = tiles[meets], corners[meets]
            middle = (low + high) / 2
        else:
            middle = np.median(corners, axis=0) if len(corners) else np.zeros(3)
        away_m = np.linalg.norm(corners + self.side_m / 2 - middle, axis=1)
        return [(x, y, z) for x, y, z in tiles[np.argsort(away_m, kind="stable")].tolist()]


class FileFollower:
    """Mesh tiles of a file within a box."""

    def __init__(
        self,
        maker: TileMaker,
        level: LevelTiles,
        bounds: Bounds | None,
        made: Mapping[TileIndex, MadeTile],
    ) -> None:
        """``made`` are tiles of the level that are there already."""
        self._maker = maker
        self._level = level
        self._order = maker.order(level, TilesInBox(bounds, level.side_m), made)
        self._take_up(self._order.made.copy())
        self.complete = False
        """Whether the last refresh left nothing waiting."""

    def refresh(self) -> None:
        """Take up what is made within a short time."""
        self.wait(_WAIT_S)

    def wait(self, timeout_s: float) -> None:
        """Take up what is made until all is, or the time is over; errors as of :meth:`refresh`."""
        if self.complete:  # a file does not change
            return
        complete = self._maker.wait(self._order, timeout_s)
        self._take_up(self._maker.collect(self._order))
        self.complete = complete

    def moved(self, bounds: Bounds) -> "FileFollower":
        """Follow another box instead: what was made is still known."""
        self.close()
        return FileFollower(self._maker, self._level, bounds, made=self._made)

    def close(self) -> None:
        """Follow no longer."""
        self._maker.cancel(self._order)

    def _take_up(self, made: Mapping[TileIndex, MadeTile]) -> None:
        self._made = made
        self.tiles = {index: tile for index, tile in made.items() if len(tile.faces)}
        """The tiles as of the last refresh, by their indices."""
