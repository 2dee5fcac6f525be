"""The mesh in a scene: coarse everywhere, finer where the camera is near."""

from collections.abc import Hashable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
import viser
from triquad_client.mesh.followed_mesh import MeshTile
from triquad_client.mesh.mesh_files import GlbMesh, glb_bytes
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.mesh.overview_camera import OverviewCamera
from triquad_tools.viewer.mesh.tile_colours import (
    TileColours,
    confidence_colours,
    height_colours,
    lit_colours,
)
from triquad_tools.viewer.mesh.tiles_in_view import TileName, TilesInView
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.page import Page

_PERIOD_S = 0.5
_HEIGHT, _CONFIDENCE = "height", "confidence"
_PIXELS = 4  # of a cell
_ENOUGH = 200  # vertices of a tile, to know where it is


class _DrawnTile(NamedTuple):
    """The part of the scene for a tile."""

    appearance: Hashable  # if this is another one, the drawing is outdated
    handle: viser.GlbHandle


class MeshLayer(Layer):
    """Draws the mesh, and keeps it up to date with map and camera."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Mesh", _PERIOD_S)
        self._camera = OverviewCamera(page)
        self._framed = False
        self._tiles = TilesInView(page.source)
        self._replacing = False  # tiles of the map that was shown before are drawn
        self._shown: dict[TileName, _DrawnTile] = {}
        self._replaced: list[viser.GlbHandle] = []  # they go a round later: nothing flickers
        with self.folder:
            self._by = page.gui.add_dropdown("Colour", (_HEIGHT, _CONFIDENCE))
            self.add_text()
            self._pixels = page.gui.add_slider("Pixels per cell", 1, 20, 1, _PIXELS)
        page.client.camera.on_update(self.wake)
        self.start(self._by, self._pixels)

    def close(self) -> None:
        """Draw no more; remove what was drawn and the folder."""
        super().close()
        for handle in (*self._replaced, *(drawn.handle for drawn in self._shown.values())):
            handle.remove()
        self._tiles.close()

    def refresh(self) -> None:
        """Draw what came since the last round, and remove what it replaces."""
        for handle in self._replaced:
            handle.remove()
        self._replaced.clear()
        if self._tiles.source is not self.page.source:
            self._tiles.close()
            self._tiles = TilesInView(self.page.source)
            self._replacing = True
        camera = self.page.client.camera
        pixel_m = camera.fov / max(camera.image_height, 1)  # at a distance of one metre
        wanted = self._tiles.refresh(self.page.eye, self._pixels.value * pixel_m)
        self._replacing &= not self._tiles.loaded
        if not self._tiles.loaded:
            self.wake()
        if not self._replacing:
            self._draw(wanted)

    def _draw(self, wanted: Mapping[TileName, MeshTile]) -> None:
        """Draw these tiles alone; those that they replace go a round later."""
        points = _some_vertices(self._tiles.roots.values())
        if self.page.source.grows or not self._framed:
            self._camera.follow(points)
            self._framed = self._tiles.loaded
        colours = self._colours(points)
        self.tell(colours.scale.html)
        for name, tile in wanted.items():
            appearance = (colours.scale.label, colours.scale.low, colours.scale.high, tile.version)
            drawn = self._shown.get(name)
            if drawn is None or drawn.appearance != appearance:
                self._shown[name] = _DrawnTile(appearance, self._add(tile, colours))
                self._replaced += [drawn.handle] if drawn else []
        for name in self._shown.keys() - wanted.keys():
            self._replaced.append(self._shown.pop(name).handle)

    def _colours(self, points: Doubles) -> TileColours:
        """Return the chosen colours, for a mesh with some ``points`` [N, 3]."""
        if self._by.value == _CONFIDENCE:
            return confidence_colours(self.page.source.queries)
        return height_colours(points[:, 2])

    def _add(self, tile: MeshTile, colours: TileColours) -> viser.GlbHandle:
        mesh = GlbMesh("tile", tile.vertices, tile.faces, lit_colours(colours, tile))
        return self.page.scene.add_glb(
            self.node("tile"), glb_bytes([mesh]), position=self.page.in_scene(tile.origin),
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip


def _some_vertices(tiles: Iterable[MeshTile]) -> Doubles:
    """Return vertices [N, 3] of all tiles, enough to know where these are; metres, map frame."""
    some = [tile.origin + tile.vertices[:: max(1, len(tile.vertices) // _ENOUGH)] for tile in tiles]
    return np.concatenate([np.zeros((0, 3)), *some])
