"""The mesh tiles of a scene: coarse ones everywhere, finer ones where the camera is near."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from triquad_client.mesh.followed_mesh import MeshTile, TileIndex
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.sources import COARSEST, MapSource, TileFollower

_PERIOD_S = 1.0  # between questions what changed: more often, and a robot's planner would notice


@dataclass(frozen=True)
class TileName:
    """A tile among those of all levels."""

    level: int
    index: TileIndex


class NearTiles:
    """The tiles of a finer level around the eye."""

    def __init__(self, source: MapSource, level: int) -> None:
        self._source = source
        self.level = level
        self._follower: TileFollower | None = None
        self._roots: set[TileIndex] = set()  # tiles of the coarsest level that are followed
        self.zero: Doubles = np.zeros(3)  # metres, map frame: from where tiles count
        self.ready: set[TileIndex] = set()  # those of them in which all of this level are loaded

    @property
    def loaded(self) -> bool:
        """Whether all that is followed was complete once."""
        return self._roots <= self.ready

    def refresh(self, roots: list[TileIndex], *, changes: bool = True) -> None:
        """Fetch some of the tiles within ``roots``, of the coarsest level; none: as before.

        Where all were complete once, only if ``changes`` are wanted.
        """
        if roots:
            self._follow(roots)
        if self._follower is not None and (changes or not self.loaded):
            self._follower.next(0.0)
            if self._follower.complete:
                self.ready = self._roots

    def within(self, root: TileIndex) -> Iterator[tuple[TileName, MeshTile]]:
        """Yield the tiles within a tile of the coarsest level."""
        tiles = {} if self._follower is None else self._follower.tiles
        count = 1 << (COARSEST - self.level)
        for step in np.ndindex(count, count, count):
            x, y, z = (count * at + by for at, by in zip(root, step, strict=True))
            if (x, y, z) in tiles:
                yield TileName(self.level, (x, y, z)), tiles[x, y, z]

    def close(self) -> None:
        """Stop following."""
        if self._follower is not None:
            self._follower.close()

    def _follow(self, roots: list[TileIndex]) -> None:
        low, high = np.min(roots, axis=0), np.max(roots, axis=0)
        steps = np.ndindex(*(high - low + 1))
        around = {(int(low[0] + x), int(low[1] + y), int(low[2] + z)) for x, y, z in steps}
        if around == self._roots:
            return
        # To the middles of the outermost tiles: those at their side do not meet the box.
        sizes = self._source.sizes
        side_m, inwards_m = sizes.side_of(COARSEST), 0.5 * sizes.side_of(self.level)
        least, most = low * side_m + inwards_m, (high + 1) * side_m - inwards_m
        ends = (self.zero + least).tolist(), (self.zero + most).tolist()
        before = self._follower
        self._follower = self._source.follow(self.level, ends, before)
        if before is not None:
            before.close()
        self._roots, self.ready = around, self.ready & around


class TilesInView:
    """Follows the tiles of a map. Not for several threads."""

    def __init__(self, source: MapSource) -> None:
        self.source = source
        self._whole = source.follow(COARSEST)
        self._whole_loaded = False
        self._due_s = 0.0  # monotonic: when changes are asked for
        self._near = [NearTiles(source, level) for level in range(COARSEST)]

    @property
    def roots(self) -> Mapping[TileIndex, MeshTile]:
        """The tiles of the coarsest level, of which the whole map consists."""
        return self._whole.tiles

    @property
    def loaded(self) -> bool:
        """Whether all that is in view was complete once; from then on only changes come."""
        return self._whole_loaded and all(near.loaded for near in self._near)

    def refresh(self, eye: Doubles, coarsest_m: float) -> dict[TileName, MeshTile]:
        """Fetch some of what is new; return which tiles are to be drawn.

        Args:
            eye: [3] metres, map frame.
            coarsest_m: side that a cell may have at a distance of one metre.
        """
        now_s = time.monotonic()
        changes = now_s >= self._due_s
        if changes:
            self._due_s = now_s + _PERIOD_S
        if changes or not self._whole_loaded:
            self._whole.next(0.0)
            self._whole_loaded |= self._whole.complete
        roots = list(self.roots)
        parts = {root: {TileName(COARSEST, root): tile} for root, tile in self.roots.items()}
        side_m = self.source.sizes.side_of(COARSEST)
        zeros = (tile.origin - side_m * np.array(root) for root, tile in self.roots.items())
        zero = next(zeros, np.zeros(3))
        for near in reversed(self._near):  # finer ones replace coarser ones
            reach_m, near.zero = self.source.sizes.cell_of(near.level + 1) / coarsest_m, zero
            chosen = near_columns(roots, side_m, eye - zero, reach_m)
            near.refresh(chosen, changes=changes)
            for root in near.ready.intersection(chosen):
                parts[root] = dict(near.within(root))
        return {name: tile for tiles in parts.values() for name, tile in tiles.items()}

    def close(self) -> None:
        """Stop following."""
        self._whole.close()
        for near in self._near:
            near.close()


def near_columns(
    roots: list[TileIndex], side_m: float, eye: Doubles, reach_m: float
) -> list[TileIndex]:
    """Return the tiles above and below which there is one no farther from the eye than ``reach_m``.

    The position [3] of the eye counts from where tiles do.

    Tiles above each other have one level: where the ground lies in the side between two of them,
    as at z = 0, meshes of two levels would leave holes all over it.
    """
    corners = np.array(roots, np.float64).reshape(-1, 3) * side_m
    away_m = np.linalg.norm(np.clip(eye, corners, corners + side_m) - eye, axis=1)
    columns = {(x, y) for (x, y, _), far_m in zip(roots, away_m, strict=True) if far_m <= reach_m}
    return [root for root in roots if root[:2] in columns]
