"""The map of a file, or of a checkpoint that a page chooses, without a server."""

import threading
import time
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from triquad_client import open_map
from triquad_client.calls.queries import MapQueries
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import MeshTile, TileIndex
from triquad_client.offline.map_mesh import TILE_CELLS, MapTiles
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources.map_source import MapState, TileSizes

_CELL_LEAVES = 0.5  # of a cell of level 0, as in a server's mesh
_MAX_TILES = 500  # that are kept of an open map: some 50 to 200 MB
_WAIT_S = 0.1  # how long one refresh makes tiles


class StoredMap:
    """A map file in memory, with mesh tiles that are made once wanted; for several threads.

    It is closed once it is garbage.
    """

    def __init__(self, path: Path) -> None:
        """Read it.

        Raises:
            MapFileError: it is no map file, is damaged, or needs a newer reader.
            OSError: it cannot be read.
        """
        self.path = path
        self.opened = open_map(path)
        cell_m = _CELL_LEAVES * self.opened.leaf_m
        self.sizes = TileSizes(cell_m, TILE_CELLS * cell_m)
        self._listing = threading.Lock()
        self._listed_tiles = cache(self._listed)
        self.tile = lru_cache(_MAX_TILES)(self._made)
        """The tile of a level and an index, one of :meth:`indices`."""

    def indices(self, level: int, bounds: Bounds | None) -> list[TileIndex]:
        """Return the tiles that meet a box and may have faces, those nearest to its middle last."""
        with self._listing:
            listed = self._listed_tiles(level).indices
        tiles, side_m = np.array(list(listed), np.int64).reshape(-1, 3), self.sizes.side_of(level)
        if bounds is None:
            middle = np.median(tiles, axis=0) * side_m if len(tiles) else np.zeros(3)
        else:
            low, high = np.asarray(bounds, np.float64)
            meets = ((tiles * side_m <= high) & ((tiles + 1) * side_m >= low)).all(axis=1)
            tiles, middle = tiles[meets], (low + high) / 2
        away_m = np.linalg.norm((tiles + 0.5) * side_m - middle, axis=1)
        return [(x, y, z) for x, y, z in tiles[np.argsort(-away_m, kind="stable")].tolist()]

    def _listed(self, level: int) -> MapTiles:
        return self.opened.mesh_tiles(self.sizes.cell_of(level))

    def _made(self, level: int, index: TileIndex) -> MeshTile:
        mesh = self._listed_tiles(level).mesh(index)
        origin = np.array(index) * self.sizes.side_of(level)
        vertices = (mesh.vertices - origin).astype(np.float32)
        return MeshTile(
            index, self.opened.epoch, "", 0, origin=origin, vertices=vertices, faces=mesh.faces
        )


class StoredSource:
    """A map file that pages show, until :meth:`show` replaces it."""

    grows = False

    def __init__(self, shown: StoredMap, place: str) -> None:
        """``place`` shows people where the map is from."""
        self.shown = shown
        self.sizes = shown.sizes
        self.title = f"{shown.opened.name} in {place}"

    @property
    def queries(self) -> MapQueries:
        """The queries of the map that is shown."""
        return self.shown.opened

    def state(self) -> MapState:
        """Return what is shown."""
        opened = self.shown.opened
        stamp = utc_time(opened.stamp_ns) if opened.stamp_ns else ""
        return MapState(opened.name, opened.epoch, stamp)

    def show(self, other: StoredMap) -> None:
        """Show another map instead.

        Raises:
            ToolError: its mesh is of other cells.
        """
        if other.sizes != self.sizes:
            raise ToolError(f"{other.path} was mapped with other leaves: open it by itself")
        self.shown = other

    def follow(self, level: int, bounds: Bounds | None = None) -> "StoredFollower":
        """Follow the mesh tiles of a level that meet ``bounds``, of any map that is shown."""
        return StoredFollower(self, level, bounds)


class StoredFollower:
    """Mesh tiles of a level within a box; they change together when another map is shown."""

    def __init__(self, source: StoredSource, level: int, bounds: Bounds | None) -> None:
        self._source = source
        self._level = level
        self._bounds = bounds
        self._of: StoredMap | None = None  # whose tiles are made
        self._waiting: list[TileIndex] = []  # the next one last
        self._made: dict[TileIndex, MeshTile] = {}
        self._changing = False  # those of the map before are shown
        self.tiles: Mapping[TileIndex, MeshTile] = {}
        """The tiles as of the last refresh, by their indices; of one map."""
        self.complete = False
        """Whether the last refresh left nothing pending."""

    def refresh(self) -> None:
        """Make tiles for a short time; until all are there, those of the map before are shown."""
        shown = self._source.shown
        if self._of is not shown:
            self._changing = self._of is not None
            self._of, self._made = shown, {}
            self._waiting = shown.indices(self._level, self._bounds)
        ends_s = time.monotonic() + _WAIT_S
        while self._waiting and time.monotonic() < ends_s:
            index = self._waiting.pop()
            self._made[index] = shown.tile(self._level, index)
        self.complete = not self._waiting
        self._changing &= not self.complete
        self._publish()

    def moved(self, bounds: Bounds) -> "StoredFollower":
        """Follow another box instead: what was made is kept."""
        self._bounds = bounds
        if self._of is not None:
            wanted = self._of.indices(self._level, bounds)
            self._made = {index: self._made[index] for index in wanted if index in self._made}
            self._waiting = [index for index in wanted if index not in self._made]
            self._publish()
        return self

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def _publish(self) -> None:
        if not self._changing:
            self.tiles = {index: tile for index, tile in self._made.items() if len(tile.faces)}
