"""The mesh in a scene: coarse everywhere, finer where the camera is near."""

from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import viser
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import TileIndex

from triquad_tools.plots.picture import camera_around
from triquad_tools.viewer.detail import Viewpoint, wanted_levels
from triquad_tools.viewer.map_source import COARSEST, Tile, TileFollower
from triquad_tools.viewer.refresher import Refresher
from triquad_tools.viewer.stage import Stage
from triquad_tools.viewer.thinning import Triangles, thinned
from triquad_tools.viewer.tile_colours import HeightColours, TileColours, lit
from triquad_tools.viewer.unlit_glb import unlit_glb

_THINNED_LEVELS = 2  # beyond those that tiles come in
_PERIOD_S = 0.25


@dataclass(frozen=True)
class DrawnTile:
    """What stands in the scene for a tile."""

    version: Hashable
    handle: viser.GlbHandle


@dataclass(frozen=True)
class WantedTile:
    """What ought to."""

    tile: Tile
    level: int  # of detail, also thinned ones
    version: Hashable


class NearTiles:
    """The tiles of a finer level around the camera."""

    def __init__(self, stage: Stage, level: int) -> None:
        self._stage = stage
        self.level = level
        self._follower: TileFollower | None = None
        self._followed: Bounds | None = None
        self._around: frozenset[TileIndex] = frozenset()
        self.ready: frozenset[TileIndex] = frozenset()
        """Tiles of the coarsest level within which all of this one are there."""

    def refresh(self, roots: list[TileIndex]) -> None:
        """Fetch some of the tiles within ``roots``, tiles of the coarsest level."""
        if roots:
            self._follow(roots)
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
            self._follower = self._stage.source.follow(self.level, bounds)
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
        sizes = self._stage.source.sizes
        side_m, inwards_m = sizes.side_of(COARSEST), 0.5 * sizes.side_of(self.level)
        low = np.min(roots, axis=0) * side_m + inwards_m
        high = (np.max(roots, axis=0) + 1) * side_m - inwards_m
        return low.tolist(), high.tolist()


class MeshLayer:
    """Draws the mesh, and keeps it up to date with map and camera."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._whole = stage.source.follow(COARSEST)
        self._near = [NearTiles(stage, level) for level in reversed(range(COARSEST))]
        self._drawn: dict[tuple[int, TileIndex], DrawnTile] = {}
        self._retired: list[viser.GlbHandle] = []
        self._colours: TileColours = HeightColours(0.0, 1.0)
        self._framed = False
        sizes = stage.source.sizes
        self._cells_m = np.array([sizes.cell_of(level) for level in range(COARSEST + 1)])
        self._cells_m = np.append(
            self._cells_m, sizes.cell_of(COARSEST) * 2.0 ** np.arange(1, _THINNED_LEVELS + 1)
        )
        self._folder = stage.gui.add_folder("Mesh")
        with self._folder:
            self._pixels = stage.gui.add_slider("Pixels per cell", 1, 20, 1, 4)
        self._refresher = Refresher("mesh", self._refresh, _PERIOD_S, stage.failed)
        self._pixels.on_update(lambda _: self._refresher.wake())
        stage.client.camera.on_update(lambda _: self._refresher.wake())

    def close(self) -> None:
        """Draw no more."""
        self._refresher.close()
        self._whole.close()
        for near in self._near:
            near.close()
        for handle in (*self._retired, *(drawn.handle for drawn in self._drawn.values())):
            handle.remove()
        self._folder.remove()

    def _refresh(self) -> None:
        for handle in self._retired:  # what came in their place is drawn by now
            handle.remove()
        self._retired.clear()
        self._whole.refresh()
        roots = self._whole.tiles
        if not roots:
            return
        if not self._framed:
            self._frame(roots.values())
        levels = self._wanted_levels(roots)
        for near in self._near:
            near.refresh([index for index, level in levels.items() if level <= near.level])
        self._colours = HeightColours.of_tiles(roots.values())
        self._show(dict(self._wanted(roots, levels)))

    def _frame(self, tiles: Iterable[Tile]) -> None:
        """Look at all there is so far."""
        points = np.concatenate([tile.origin + tile.vertices for tile in tiles])
        around = camera_around(points)
        camera = self._stage.client.camera
        camera.position = self._stage.in_scene(around.eye)
        camera.look_at = self._stage.in_scene(around.target)
        self._framed = True

    def _wanted_levels(self, roots: Mapping[TileIndex, Tile]) -> dict[TileIndex, int]:
        camera = self._stage.client.camera
        viewpoint = Viewpoint(
            self._stage.in_map(camera.position), camera.fov / max(camera.image_height, 1)
        )
        side_m = self._stage.source.sizes.side_of(COARSEST)
        corners = np.array(list(roots), np.float64) * side_m
        levels = wanted_levels(
            corners, side_m, self._cells_m, viewpoint=viewpoint, pixels=self._pixels.value
        )
        return dict(zip(roots, levels.tolist(), strict=True))

    def _wanted(
        self, roots: Mapping[TileIndex, Tile], levels: Mapping[TileIndex, int]
    ) -> Iterator[tuple[tuple[int, TileIndex], WantedTile]]:
        """What is to be drawn, by level of detail and index."""
        for root, tile in roots.items():
            level = levels[root]
            ready = [near for near in self._near if root in near.ready and near.level >= level]
            if ready:
                finest = min(ready, key=lambda near: near.level)
                for index, part in finest.within(root):
                    yield (finest.level, index), self._version(part, finest.level)
            else:
                shown = max(level, COARSEST)
                yield (COARSEST, root), self._version(tile, shown)

    def _version(self, tile: Tile, level: int) -> WantedTile:
        return WantedTile(tile, level, (tile.version, level, self._colours.key(tile)))

    def _show(self, wanted: Mapping[tuple[int, TileIndex], WantedTile]) -> None:
        for name, want in wanted.items():
            drawn = self._drawn.get(name)
            if drawn is None or drawn.version != want.version:
                self._draw(name, want)
        for name in self._drawn.keys() - wanted.keys():
            self._retired.append(self._drawn.pop(name).handle)

    def _draw(self, name: tuple[int, TileIndex], want: WantedTile) -> None:
        """Draw a tile; what stood for it before goes once the new one is there."""
        tile = want.tile
        triangles = Triangles(tile.vertices, tile.faces)
        if want.level > COARSEST:
            triangles = thinned(*triangles, cell_m=float(self._cells_m[want.level]))
        if name in self._drawn:
            self._retired.append(self._drawn.pop(name).handle)
        if len(triangles.faces) == 0:
            return
        colours = lit(self._colours.colours(tile, triangles), triangles)
        level, (x, y, z) = name
        handle = self._stage.scene.add_glb(
            f"/mesh/{level}_{x}_{y}_{z}/{abs(hash(want.version))}",
            unlit_glb(triangles.vertices, triangles.faces, colours),
            position=tuple(self._stage.in_scene(tile.origin).tolist()),
            cast_shadow=False,
            receive_shadow=False,
        )
        self._drawn[name] = DrawnTile(want.version, handle)
