"""The sources of a page's map: a server that learns, a file, or the checkpoints of a store."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from triquad_client import Client, open_map
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import MeshTile, TileIndex
from triquad_client.mesh.mesh_watch import MeshWatch
from triquad_client.offline.map_mesh import TILE_CELLS
from triquad_format.errors import DamagedMapFileError, FormatError
from triquad_format.mapfile.checkpoint_folder import CheckpointFile, checkpoint_files, map_folder
from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.reader import open_manifest
from triquad_format.wire.limits import LEVELS

from triquad_tools.console.command import ToolError

_POINT = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_CELL_LEAVES = 0.5  # of a cell of level 0, as in a server's mesh
_MAX_TILES = 500  # that are kept of an open map: some 50 to 200 MB
_WAIT_S = 0.1  # how long one refresh makes tiles

_MAX_OPEN = 4  # maps that stay in memory beyond those that pages show
COARSEST = LEVELS - 1  # level of detail of the tiles of which a whole map is shown


@dataclass(frozen=True)
class TileSizes:
    """Lengths of the mesh, metres."""

    cell_m: float  # of level 0
    tile_side_m: float  # of level 0

    def cell_of(self, level: int) -> float:
        """Return the side of the cells of a level."""
        return self.cell_m * (1 << level)

    def side_of(self, level: int) -> float:
        """Return the side of the tiles of a level."""
        return self.tile_side_m * (1 << level)


class LiveSource:
    """The map of a server; the caller closes the client."""

    grows = True  # more of it may become known while it is shown

    def __init__(self, client: Client, endpoint: str) -> None:
        """Ask the server for the lengths of its mesh."""
        self.client = self.queries = client
        self.title = f"{client.map_name} at {endpoint}"
        with client.watch_mesh(_POINT) as watch:
            watch.catch_up()
            self.sizes = TileSizes(watch.cell_m, watch.tile_side_m)

    def follow(self, level: int, bounds: Bounds | None = None, before: object = None) -> MeshWatch:
        """Follow the mesh tiles of a level that meet ``bounds``, as the server makes them.

        Those of a follower ``before``, of the same level, are not fetched again.
        """
        known = before.known_tiles() if isinstance(before, MeshWatch) else None
        return self.client.watch_mesh(bounds, level, known=known)


class FileSource:
    """A map file in memory, with mesh tiles that are made once wanted; for several threads."""

    grows = False

    def __init__(self, path: Path, place: str) -> None:
        """Read it; ``place`` shows people where the map is from."""
        self.path = path
        self.queries = open_map(path)
        self.title = f"{self.queries.name} in {place}"
        cell_m = _CELL_LEAVES * self.queries.leaf_m
        self.sizes = TileSizes(cell_m, TILE_CELLS * cell_m)
        cells_m = map(self.sizes.cell_of, range(COARSEST + 1))
        self._tiles = [self.queries.mesh_tiles(cell_m) for cell_m in cells_m]  # by level
        self.tile = lru_cache(_MAX_TILES)(self._made)  # of a level, and one of :meth:`indices`

    def follow(
        self, level: int, bounds: Bounds | None = None, before: object = None
    ) -> "StoredTiles":
        """Make the mesh tiles of a level that meet ``bounds``, metres, map frame; ``None``: all.

        Those of a follower ``before``, of the same level, are not made again.
        """
        known = before.tiles if isinstance(before, StoredTiles) else {}
        wanted = self.indices(level, bounds)
        return StoredTiles(
            partial(self.tile, level),
            waiting=[index for index in wanted if index not in known],
            tiles={index: known[index] for index in wanted if index in known},
        )

    def indices(self, level: int, bounds: Bounds | None) -> list[TileIndex]:
        """Return the tiles that meet a box and may have faces."""
        listed = self._tiles[level].indices
        if bounds is None:
            return listed
        (low, high), side_m = np.asarray(bounds, np.float64), self.sizes.side_of(level)
        corners = self._tiles[level].origin + np.array(listed, np.int64).reshape(-1, 3) * side_m
        meets = ((corners <= high) & (corners + side_m >= low)).all(axis=1)
        return [index for index, is_met in zip(listed, meets, strict=True) if is_met]

    def _made(self, level: int, index: TileIndex) -> MeshTile:
        mesh = self._tiles[level].mesh(index)
        origin = self._tiles[level].origin + np.array(index) * self.sizes.side_of(level)
        vertices = (mesh.vertices - origin).astype(np.float32)
        return MeshTile(
            index, self.queries.epoch, origin=origin, vertices=vertices, faces=mesh.faces
        )


@dataclass
class StoredTiles:
    """Mesh tiles of a map file within a box, which are made bit by bit."""

    make: Callable[[TileIndex], MeshTile]
    waiting: list[TileIndex]  # to be made, the next one last
    tiles: dict[TileIndex, MeshTile]  # with faces, that are made

    @property
    def complete(self) -> bool:
        """Whether all tiles are made."""
        return not self.waiting

    def next(self, timeout_s: float) -> None:
        """Make tiles for as long, and no less than a tenth of a second."""
        ends_s = time.monotonic() + max(timeout_s, _WAIT_S)
        while self.waiting and time.monotonic() < ends_s:
            tile = self.make(self.waiting.pop())
            if len(tile.faces):
                self.tiles[tile.index] = tile

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


MapSource = LiveSource | FileSource
"""A map to show: each has a title, queries, the sizes of its mesh, and tiles to follow."""

TileFollower = MeshWatch | StoredTiles
"""The mesh tiles of a level within a box, which ``next`` brings up to date bit by bit."""


class DamagedError(ToolError):
    """A checkpoint that cannot be shown."""


class History:
    """The checkpoints of one map in a store, to which a server may add; for several threads."""

    def __init__(self, store: Path) -> None:
        """Find the folder."""
        self.folder = map_folder(store)
        self._damaged: dict[CheckpointFile, str] = {}  # as far as is known, and why
        self._opening = threading.Lock()  # one at a time: it takes all cores
        self._open = lru_cache(_MAX_OPEN)(lambda path: FileSource(path, str(self.folder)))

    def files(self) -> list[CheckpointFile]:
        """Return the checkpoints that can be shown as far as is known, the oldest first.

        Raises:
            ToolError: the folder cannot be read.
        """
        try:
            found = checkpoint_files(self.folder)
        except OSError as error:
            raise ToolError(f"{self.folder} cannot be read: {error.strerror}") from error
        return [file for file in reversed(found) if file not in self._damaged]

    def damaged(self) -> list[str]:
        """Return the errors of those that cannot be shown and are still there."""
        return [why for file, why in sorted(self._damaged.items()) if file.path.exists()]

    def opened(self, file: CheckpointFile) -> FileSource:
        """Return the map as it was.

        Raises:
            DamagedError: it cannot be shown; it is among the files no longer.
        """
        try:
            with self._opening:
                return self._open(file.path)
        except (FormatError, OSError) as error:
            self._damaged[file] = f"{file.path.name} is left out: {error}"
            raise DamagedError(self._damaged[file]) from error

    def newest(self) -> FileSource:
        """Return the map as it was at the newest moment that can be shown.

        Raises:
            DamagedMapFileError: there is none.
        """
        while files := self.files():
            with suppress(DamagedError):
                return self.opened(files[-1])
        told = "no checkpoint can be shown; triquad-pack --recover saves what is intact"
        raise DamagedMapFileError(f"{self.folder}: {told}")


@lru_cache
def moment(file: CheckpointFile) -> str:
    """Return the epoch of a checkpoint, and its time, UTC as in RFC 3339, if the file says it."""
    with suppress(FormatError, OSError):
        if stamp_ns := open_manifest(file).stamp_ns:
            return f"epoch {file.epoch}, {utc_time(stamp_ns)}"
    return f"epoch {file.epoch}"
