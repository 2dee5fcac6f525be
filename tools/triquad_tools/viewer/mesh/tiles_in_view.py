"""Which mesh tiles a scene shows: coarse ones everywhere, finer ones where the camera is near."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_client.mesh.followed_mesh import TileIndex

from triquad_tools.viewer.mesh.detail import Viewpoint, wanted_levels
from triquad_tools.viewer.mesh.near_tiles import NearTiles
from triquad_tools.viewer.sources.map_source import COARSEST, MapSource, Tile

_THINNED_LEVELS = 2  # coarser than those that tiles come in


@dataclass(frozen=True)
class TileName:
    """A tile among those of all levels."""

    level: int  # of detail, as it came
    index: TileIndex


class WantedTile(NamedTuple):
    """A tile that ought to be in the scene."""

    tile: Tile
    level: int  # of detail, as it is drawn: also of those that are thinned here


class TilesInView:
    """Follows the tiles of a map. Not for several threads."""

    def __init__(self, source: MapSource) -> None:
        self._side_m = source.sizes.side_of(COARSEST)
        self._whole = source.follow(COARSEST)
        self._whole_loaded = False
        self._near = [NearTiles(source, level) for level in range(COARSEST)]
        levels = range(COARSEST + 1 + _THINNED_LEVELS)
        self._cells_m = np.array([source.sizes.cell_of(level) for level in levels])

    @property
    def roots(self) -> Mapping[TileIndex, Tile]:
        """The tiles of the coarsest level, of which the whole map consists."""
        return self._whole.tiles

    @property
    def roots_complete(self) -> bool:
        """Whether the last refresh left none of them waiting."""
        return self._whole.complete

    @property
    def loaded(self) -> bool:
        """Whether all that is in view was there once; from then on only changes come."""
        return self._whole_loaded and all(near.loaded for near in self._near)

    def refresh_roots(self) -> None:
        """Fetch some of what is new."""
        self._whole.refresh()
        self._whole_loaded |= self._whole.complete

    def refresh_near(self, viewpoint: Viewpoint, pixels: float) -> dict[TileName, WantedTile]:
        """Fetch some of the finer tiles near an eye; returns what of all tiles is to be drawn.

        Args:
            viewpoint: of the eye.
            pixels: that a cell may cover on the screen.
        """
        roots = self.roots
        corners = np.array(list(roots), np.float64).reshape(-1, 3) * self._side_m
        wanted = wanted_levels(
            corners, self._side_m, self._cells_m, viewpoint=viewpoint, pixels=pixels
        )
        levels = dict(zip(roots, wanted.tolist(), strict=True))
        for near in self._near:
            near.move([index for index, level in levels.items() if level <= near.level])
            near.refresh()
        return dict(self._wanted(roots, levels))

    def close(self) -> None:
        """Follow no longer."""
        self._whole.close()
        for near in self._near:
            near.close()

    def _wanted(
        self, roots: Mapping[TileIndex, Tile], levels: Mapping[TileIndex, int]
    ) -> Iterator[tuple[TileName, WantedTile]]:
        for root, tile in roots.items():
            level = levels[root]
            ready = [near for near in self._near if near.level >= level and root in near.ready]
            if ready:
                finest = ready[0]
                for index, part in finest.within(root):
                    yield TileName(finest.level, index), WantedTile(part, finest.level)
            else:
                yield TileName(COARSEST, root), WantedTile(tile, max(level, COARSEST))
