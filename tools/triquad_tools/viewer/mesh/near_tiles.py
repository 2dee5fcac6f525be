"""The tiles of a finer level around the camera."""

from collections.abc import Iterator

import numpy as np
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import TileIndex

from triquad_tools.viewer.sources.map_source import COARSEST, MapSource, Tile, TileFollower


class NearTiles:
    """The tiles of a finer level around the camera."""

    def __init__(self, source: MapSource, level: int) -> None:
        self._source = source
        self.level = level
        self._follower: TileFollower | None = None
        self._followed: Bounds | None = None
        self._around: frozenset[TileIndex] = frozenset()
        self.ready: frozenset[TileIndex] = frozenset()
        """Tiles of the coarsest level within which all of this one are there."""

    @property
    def loaded(self) -> bool:
        """Whether all that is followed was there once."""
        return self._around <= self.ready

    def move(self, roots: list[TileIndex]) -> None:
        """Follow the tiles within ``roots``, tiles of the coarsest level; none: as before."""
        if roots:
            self._follow(roots)

    def refresh(self) -> None:
        """Fetch some of what is new."""
        if self._follower is None:
            return
        self._follower.refresh()
        if self._follower.complete:
            self.ready = self._around

    def within(self, root: TileIndex) -> Iterator[tuple[TileIndex, Tile]]:
        """The tiles within a tile of the coarsest level."""
        tiles = {} if self._follower is None else self._follower.tiles
        count = 1 << (COARSEST - self.level)
        for step in np.ndindex(count, count, count):
            x, y, z = (count * at + by for at, by in zip(root, step, strict=True))
            if (x, y, z) in tiles:
                yield (x, y, z), tiles[x, y, z]

    def close(self) -> None:
        """Follow no longer."""
        if self._follower is not None:
            self._follower.close()

    def _follow(self, roots: list[TileIndex]) -> None:
        bounds = self._box(roots)
        if bounds == self._followed:
            return
        if self._follower is None:
            self._follower = self._source.follow(self.level, bounds)
        else:
            self._follower = self._follower.moved(bounds)
        self._followed = bounds
        low, high = np.min(roots, axis=0), np.max(roots, axis=0)
        steps = np.ndindex(*(high - low + 1))
        self._around = frozenset(
            (int(low[0]) + x, int(low[1]) + y, int(low[2]) + z) for x, y, z in steps
        )
        self.ready &= self._around

    def _box(self, roots: list[TileIndex]) -> Bounds:
        """A box in the middles of the outermost tiles: those beside it do not meet it."""
        sizes = self._source.sizes
        side_m, inwards_m = sizes.side_of(COARSEST), 0.5 * sizes.side_of(self.level)
        low = np.min(roots, axis=0) * side_m + inwards_m
        high = (np.max(roots, axis=0) + 1) * side_m - inwards_m
        return low.tolist(), high.tolist()
