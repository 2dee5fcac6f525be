"""The mesh in a scene: coarse everywhere, finer where the camera is near."""

from collections.abc import Iterable

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.mesh.detail import Viewpoint
from triquad_tools.viewer.mesh.drawn_tiles import DrawnTiles
from triquad_tools.viewer.mesh.overview_camera import OverviewCamera
from triquad_tools.viewer.mesh.tile_colours import (
    AgeColours,
    ConfidenceColours,
    HeightColours,
    TileColours,
)
from triquad_tools.viewer.mesh.tiles_in_view import TilesInView
from triquad_tools.viewer.page.legends import Legend
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.refresher import Refresher
from triquad_tools.viewer.sources.map_source import Tile

_NAME = "mesh"
_PERIOD_S = 0.5
_HEIGHT, _AGE, _CONFIDENCE = "height", "age", "confidence"
_PIXELS = 4  # of a cell
_ENOUGH = 200  # vertices of a tile, to know where it is


class MeshLayer:
    """Draws the mesh, and keeps it up to date with map and camera."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._camera = OverviewCamera(page)
        self._framed = False
        self._tiles = TilesInView(page.source)
        self._drawn = DrawnTiles(page)
        self._folder = page.gui.add_folder("Mesh")
        # A file does not tell in which epoch a part of it changed.
        colours = (_HEIGHT, _AGE, _CONFIDENCE) if page.source.grows else (_HEIGHT, _CONFIDENCE)
        with self._folder:
            self._by = page.gui.add_dropdown("Colour", colours)
            self._legend = page.gui.add_html("")
            self._pixels = page.gui.add_slider("Pixels per cell", 1, 20, 1, _PIXELS)
        self._refresher = Refresher(_NAME, self._refresh, period_s=_PERIOD_S, failed=page.failed)
        for control in (self._by, self._pixels):
            control.on_update(lambda _: self._refresher.wake())
        page.client.camera.on_update(lambda _: self._refresher.wake())

    def close(self) -> None:
        """Draw no more; what was drawn and the folder go."""
        self._refresher.close()
        self._page.legends.hide(_NAME)
        self._tiles.close()
        self._drawn.clear()
        self._folder.remove()

    def _refresh(self) -> None:
        """One round: what came since the last one is drawn, and what it replaces goes."""
        self._drawn.remove_replaced()
        self._tiles.refresh_roots()
        roots = self._tiles.roots
        if not roots:  # there is no map yet, or it was reset
            self._page.legends.hide(_NAME)
            self._drawn.clear()
            return
        points = _some_vertices(roots.values())
        if self._page.source.grows or not self._framed:
            self._camera.follow(points)
            self._framed = self._tiles.roots_complete
        wanted = self._tiles.refresh_near(self._viewpoint(), self._pixels.value)
        self._drawn.show(wanted, self._colours(points))
        if not self._tiles.loaded:
            self._refresher.wake()

    def _viewpoint(self) -> Viewpoint:
        camera = self._page.client.camera
        radians_per_pixel = camera.fov / max(camera.image_height, 1)
        return Viewpoint(self._page.in_map(camera.position), radians_per_pixel)

    def _colours(self, points: Doubles) -> TileColours:
        """The colours that are chosen, for a mesh with some ``points`` [N, 3], and their legend."""
        colours: TileColours
        if self._by.value == _AGE:
            colours = AgeColours.of_tiles(self._tiles.roots.values())
        elif self._by.value == _CONFIDENCE:
            colours = ConfidenceColours(self._page.source.queries)
        else:
            colours = HeightColours.of_heights(points[:, 2])
        legend = Legend(colours.scale)
        self._page.legends.show(_NAME, legend)
        if self._legend.content != legend.html:
            self._legend.content = legend.html
        return colours


def _some_vertices(tiles: Iterable[Tile]) -> Doubles:
    """Vertices [N, 3] of all tiles, enough to know where these are; metres, map frame."""
    some = [tile.origin + tile.vertices[:: max(1, len(tile.vertices) // _ENOUGH)] for tile in tiles]
    return np.concatenate([np.zeros((0, 3)), *some])
