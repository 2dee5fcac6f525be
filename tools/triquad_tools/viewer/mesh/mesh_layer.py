"""The mesh in a scene: finer where the camera is near, which shows all until a person moves it."""

import math
from collections import deque
from collections.abc import Hashable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
import viser
from triquad_client.mesh.followed_mesh import MeshTile
from triquad_client.mesh.mesh_files import GlbMesh, glb_bytes
from triquad_format.records.arrays import Doubles

from triquad_tools.plots.mesh_view import view_axes
from triquad_tools.viewer.mesh.tile_colours import (
    TileColours,
    confidence_colours,
    height_colours,
    lit_colours,
)
from triquad_tools.viewer.mesh.tiles_in_view import TileName, TilesInView
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.page import Page

_NEAR_M, _FAR_M = 0.1, 20_000.0
_VIEW_RAD = math.radians(50.0)
_TOWARDS_EYE = np.array([-0.45, -0.65, 0.62])
_FRAMED = (1.0, 99.0)  # percentiles: what lies far away from all else does not make it small
_MARGIN = 1.05
_LEAST_ASPECT = 0.1
_GROWN = 0.02  # share of the camera's distance; a smaller step is not worth a jump
_SAME = 1e-3
_EYES = 64  # places where it was put last: what a browser reports is not as old as those before

_PERIOD_S = 0.5
_HEIGHT, _CONFIDENCE = "height", "confidence"
_PIXELS = 4  # of a cell
_ENOUGH = 200  # vertices of a tile, to know where it is


class View(NamedTuple):
    """The camera's position and target: [3] metres, map frame."""

    eye: Doubles
    target: Doubles


def view_of(points: Doubles, aspect: float) -> View:
    """Return an oblique view from above of nearly all ``points`` [N, 3], at least one."""
    axes = view_axes(-_TOWARDS_EYE)
    seen = points @ axes.T
    middle = 0.5 * np.percentile(seen, _FRAMED, axis=0).sum(axis=0)
    right, down, ahead = (seen - middle).T
    tangent = math.tan(0.5 * _VIEW_RAD)
    needed = np.maximum(np.abs(right) / aspect, np.abs(down)) / tangent - ahead
    distance_m = _MARGIN * max(float(np.percentile(needed, _FRAMED[1])), _NEAR_M)
    return View((middle - [0.0, 0.0, distance_m]) @ axes, middle @ axes)


class OverviewCamera:
    """Moves the camera of a scene back as the map grows."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._taken = False
        camera = page.client.camera
        camera.fov, camera.near, camera.far = _VIEW_RAD, _NEAR_M, _FAR_M
        # The browser reports each place late: only one where it never was put is a person's.
        self._eyes = deque([np.array(camera.position)], _EYES)  # [3] in the scene
        camera.on_update(self._moved)

    def follow(self, points: Doubles) -> None:
        """Show all of ``points`` [N, 3], metres, map frame, unless a person moved the camera."""
        if self._taken or not len(points):
            return
        camera = self._page.client.camera
        view = view_of(points, max(camera.aspect, _LEAST_ASPECT))
        eye, target = self._page.in_scene(view.eye), self._page.in_scene(view.target)
        away_m = float(np.linalg.norm(eye - target))
        if float(np.linalg.norm(eye - self._eyes[-1])) > _GROWN * away_m:
            self._eyes.append(np.asarray(eye, np.float64))
            with self._page.client.atomic():
                camera.position = eye
                camera.look_at = target

    def release(self) -> None:
        """Follow again, even if a person moved the camera."""
        self._taken = False
        self._eyes.append(np.array(self._page.client.camera.position))

    def _moved(self, camera: viser.CameraHandle) -> None:
        away_m = np.linalg.norm(np.array(self._eyes) - camera.position, axis=1)
        self._taken |= bool(away_m.min() > _SAME * (1.0 + np.linalg.norm(camera.position)))


class _DrawnTile(NamedTuple):
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

    def show_all(self) -> None:
        """Look at all that was seen."""
        self._camera.release()
        self._framed = False
        self.wake()

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
        colours = height_colours(points[:, 2])
        if self._by.value == _CONFIDENCE:
            colours = confidence_colours(self.page.source.queries)
        self.tell(colours.scale.html)
        for name, tile in wanted.items():
            appearance = (colours.scale.label, colours.scale.low, colours.scale.high, tile.version)
            drawn = self._shown.get(name)
            if drawn is None or drawn.appearance != appearance:
                self._shown[name] = _DrawnTile(appearance, self._add(tile, colours))
                self._replaced += [drawn.handle] if drawn else []
        for name in self._shown.keys() - wanted.keys():
            self._replaced.append(self._shown.pop(name).handle)

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
