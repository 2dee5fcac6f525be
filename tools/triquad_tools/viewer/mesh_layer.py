"""The mesh in a scene: coarse everywhere, finer where the camera is near."""

import time
from collections.abc import Hashable, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import viser
from triquad_client.mesh.followed_mesh import TileIndex
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.detail import Viewpoint, wanted_levels
from triquad_tools.viewer.framing import Framing
from triquad_tools.viewer.legend import legend_html
from triquad_tools.viewer.map_source import COARSEST, Tile
from triquad_tools.viewer.near_tiles import NearTiles
from triquad_tools.viewer.refresher import Refresher
from triquad_tools.viewer.stage import Stage
from triquad_tools.viewer.thinning import Triangles, thinned
from triquad_tools.viewer.tile_colours import (
    AgeColours,
    ConfidenceColours,
    HeightColours,
    TileColours,
    lit_colours,
)
from triquad_tools.viewer.unlit_glb import unlit_glb

_THINNED_LEVELS = 2  # coarser than those that tiles come in
_PERIOD_S = 0.5
_HEIGHT, _AGE, _CONFIDENCE = "height", "age", "confidence"
_PIXELS = 4  # of a cell
_ENOUGH = 200  # vertices of a tile, to know where it is

Name = tuple[int, TileIndex]
"""Level of detail of the lattice, and index in it."""


class WantedTile(NamedTuple):
    """A tile that ought to be in the scene."""

    tile: Tile
    level: int  # of detail, also of those that are thinned here
    look: Hashable  # what is drawn looks otherwise where this is another one


class DrawnTile(NamedTuple):
    """What is in the scene for a tile."""

    look: Hashable
    handle: viser.GlbHandle | None  # None: no triangle was left


class MeshLayer:
    """Draws the mesh, and keeps it up to date with map and camera."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._framing = Framing(stage)
        self._framed = False
        self._whole = stage.source.follow(COARSEST)
        self._near = [NearTiles(stage.source, level) for level in range(COARSEST)]
        self._drawn: dict[Name, DrawnTile] = {}
        self._retired: list[viser.GlbHandle] = []
        self._number = 0
        self._asked_s = -np.inf  # monotonic
        levels = COARSEST + 1 + _THINNED_LEVELS
        self._cells_m = np.array([stage.source.sizes.cell_of(level) for level in range(levels)])
        self._folder = stage.gui.add_folder("Mesh")
        # A file does not tell in which epoch a part of it changed.
        colours = (_HEIGHT, _AGE, _CONFIDENCE) if stage.source.grows else (_HEIGHT, _CONFIDENCE)
        with self._folder:
            self._by = stage.gui.add_dropdown("Colour", colours)
            self._legend = stage.gui.add_html("")
            self._pixels = stage.gui.add_slider("Pixels per cell", 1, 20, 1, _PIXELS)
        self._refresher = Refresher("mesh", self._refresh, _PERIOD_S, stage.failed)
        for control in (self._by, self._pixels):
            control.on_update(lambda _: self._refresher.wake())
        stage.client.camera.on_update(lambda _: self._refresher.wake())

    def close(self) -> None:
        """Draw no more; what was drawn and the folder go."""
        self._refresher.close()
        self._whole.close()
        for near in self._near:
            near.close()
        self._erase()
        self._remove_retired()
        self._folder.remove()

    def _erase(self) -> None:
        """Have nothing drawn from the next round on."""
        self._stage.legends.scales.pop("mesh", None)
        for name in list(self._drawn):
            self._retire(name)

    def _refresh(self) -> None:
        """One round: what came since the last one is drawn, and what it replaces goes."""
        self._remove_retired()
        asking = time.monotonic() - self._asked_s >= _PERIOD_S
        if asking or not self._whole.complete:
            self._asked_s = time.monotonic()
            self._whole.refresh()
        roots = self._whole.tiles
        if not roots:
            self._erase()  # the map may have been reset
            return
        points = _some_vertices(roots.values())
        if self._stage.source.grows or not self._framed:
            self._framing.follow(points)
            self._framed = self._whole.complete
        levels = self._wanted_levels(roots)
        for near in self._near:
            within = [index for index, level in levels.items() if level <= near.level]
            near.move(within)
            if asking or not near.complete:
                near.refresh()
        self._show(dict(self._wanted(roots, levels)), self._colours(roots, points))
        if not (self._whole.complete and all(near.complete for near in self._near)):
            self._refresher.wake()

    def _colours(self, roots: Mapping[TileIndex, Tile], points: Doubles) -> TileColours:
        colours: TileColours
        if self._by.value == _AGE:
            colours = AgeColours.of_tiles(roots.values())
        elif self._by.value == _CONFIDENCE:
            colours = ConfidenceColours(self._stage.source.queries)
        else:
            colours = HeightColours.of_heights(points[:, 2])
        self._stage.legends.scales["mesh"] = colours.scale
        legend = legend_html(colours.scale)
        if self._legend.content != legend:
            self._legend.content = legend
        return colours

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
    ) -> Iterator[tuple[Name, tuple[Tile, int]]]:
        """The tiles that are to be drawn, with their level of detail."""
        for root, tile in roots.items():
            level = levels[root]
            ready = [near for near in self._near if near.level >= level and root in near.ready]
            if ready:
                for index, part in ready[0].within(root):  # the finest
                    yield (ready[0].level, index), (part, ready[0].level)
            else:
                yield (COARSEST, root), (tile, max(level, COARSEST))

    def _show(self, wanted: Mapping[Name, tuple[Tile, int]], colours: TileColours) -> None:
        for name, (tile, level) in wanted.items():
            look = (tile.version, level, type(colours), colours.key(tile))
            drawn = self._drawn.get(name)
            if drawn is None or drawn.look != look:
                self._draw(name, WantedTile(tile, level, look), colours)
        for name in self._drawn.keys() - wanted.keys():
            self._retire(name)

    def _draw(self, name: Name, want: WantedTile, colours: TileColours) -> None:
        """Draw a tile; what stood for it before goes in the next round."""
        triangles = Triangles(want.tile.vertices, want.tile.faces)
        if want.level > COARSEST:
            side_m = self._stage.source.sizes.side_of(COARSEST)
            triangles = thinned(triangles, float(self._cells_m[want.level]), side_m)
        handle = None
        if len(triangles.faces):
            self._number += 1
            handle = self._stage.scene.add_glb(
                f"/mesh/{self._number}",
                unlit_glb(*triangles, colours=lit_colours(colours, want.tile, triangles)),
                position=self._stage.in_scene(want.tile.origin),
                cast_shadow=False,
                receive_shadow=False,
            )
        self._retire(name)
        self._drawn[name] = DrawnTile(want.look, handle)

    def _retire(self, name: Name) -> None:
        drawn = self._drawn.pop(name, None)
        if drawn is not None and drawn.handle is not None:
            self._retired.append(drawn.handle)

    def _remove_retired(self) -> None:
        for handle in self._retired:
            handle.remove()
        self._retired.clear()


def _some_vertices(tiles: Iterable[Tile]) -> Doubles:
    """Vertices [N, 3] of all tiles, enough to know where these are; metres, map frame."""
    some = [tile.origin + tile.vertices[:: max(1, len(tile.vertices) // _ENOUGH)] for tile in tiles]
    return np.concatenate([np.zeros((0, 3)), *some])
