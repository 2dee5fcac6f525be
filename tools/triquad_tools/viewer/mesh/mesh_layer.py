"""The mesh in a scene: finer where the camera is near, which shows all until a person moves it."""

import math
from collections import deque
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import viser
from triquad_client import Mesh
from triquad_client.mesh.followed_mesh import MeshTile
from triquad_client.mesh.mesh_files import GlbMesh, glb_bytes
from triquad_format.records.arrays import Doubles
from triquad_map.triangles import Triangles, joined

from triquad_tools.plots.picture import view_axes
from triquad_tools.viewer.mesh.tile_colours import (
    confidence_colours,
    height_colours,
    height_range,
    lit_colours,
)
from triquad_tools.viewer.mesh.tiles_in_view import TileName, TilesInView
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import text_html
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
_CUT_M = 0.1  # steps of the slider
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
    tile: MeshTile  # as it was cut
    handles: Sequence[viser.GlbHandle]  # one, or none where nothing is left of it


class MeshLayer(Layer):
    """Draws the mesh, and keeps it up to date with map and camera."""

    def __init__(self, page: Page) -> None:
        super().__init__(page, "Mesh", _PERIOD_S)
        self._camera = OverviewCamera(page)
        self._framed = 0.0  # aspect of the page when all was framed
        self._tiles = TilesInView(page.source)
        self._replacing = False  # tiles of the map that was shown before are drawn
        self._shown: dict[TileName, _DrawnTile] = {}
        self._replaced: list[viser.GlbHandle] = []  # they go a round later: nothing flickers
        gui = page.gui
        with self.folder:
            self._on = gui.add_checkbox("Show mesh", True)
            self._by = gui.add_dropdown("Colour", (_HEIGHT, _CONFIDENCE))
            self.add_text()
            self._top = gui.add_slider("Cut above (m)", 0.0, 0.5, _CUT_M, 0.5)
            self._pixels = gui.add_slider("Pixels per cell", 1, 20, 1, _PIXELS)
            save = gui.add_button("Save mesh (GLB)")
        save.on_click(self._save)
        page.client.camera.on_update(self.wake)
        self.start(self._on, self._by, self._top, self._pixels)

    def close(self) -> None:
        """Draw no more; remove what was drawn and the folder."""
        super().close()
        for handle in (
            *self._replaced,
            *(each for one in self._shown.values() for each in one.handles),
        ):
            handle.remove()
        self._tiles.close()

    def show_all(self) -> None:
        """Look at all that was seen."""
        self._camera.release()
        self._framed = 0.0
        self.wake()

    def show_first(self, points: Doubles) -> None:
        """Look at ``points`` [N, 3], metres, map frame, as long as there is no mesh."""
        if self.page.extent is None:
            self._camera.follow(points)

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
            self.page.drawn = self._tiles.source

    def _draw(self, wanted: Mapping[TileName, MeshTile]) -> None:
        """Draw these tiles alone; those that they replace go a round later."""
        points = _some_vertices(self._tiles.roots.values())
        self.page.extent = np.stack([points.min(0), points.max(0)]) if len(points) else None
        aspect = self.page.client.camera.aspect  # another one once the panel has its place
        if self.page.source.grows or aspect != self._framed:
            self._camera.follow(points)
            self._framed = aspect if self._tiles.loaded else 0.0
        top_m = self._cut_at(*height_range(points[:, 2]))
        colours = height_colours(points[points[:, 2] <= top_m, 2])
        if self._by.value == _CONFIDENCE:
            colours = confidence_colours(self.page.source.queries)
        empty = "nothing was seen yet" if self._tiles.loaded else "the mesh is on its way"
        self.tell(colours.scale.html if len(points) else text_html(empty))
        shown = wanted if self._on.value else {}
        for name, tile in shown.items():
            scale = colours.scale
            appearance = (scale.label, scale.low, scale.high, top_m, tile.version)
            drawn = self._shown.get(name)
            if drawn is None or drawn.appearance != appearance:
                cut = cut_tile(tile, top_m)
                handles = [self._add(cut, lit_colours(colours, tile))] if len(cut.faces) else []
                self._shown[name] = _DrawnTile(appearance, cut, handles)
                self._replaced += drawn.handles if drawn else []
        for name in self._shown.keys() - shown.keys():
            self._replaced += self._shown.pop(name).handles

    def _cut_at(self, least_m: float, most_m: float) -> float:
        """Return above which height nothing is drawn; at the slider's end there is none."""
        slider, top_m = self._top, self._top.value
        top_m = most_m if top_m >= slider.max else min(max(top_m, least_m), most_m)
        slider.min, slider.max = least_m, most_m
        slider.value = top_m  # type: ignore[misc]  # mypy takes it for read-only
        self.page.top_m = top_m if top_m < most_m else math.inf
        return self.page.top_m

    def _add(self, tile: MeshTile, colours: Doubles) -> viser.GlbHandle:
        return self.page.scene.add_glb(
            self.node("tile"), glb_bytes([GlbMesh("tile", tile.vertices, tile.faces, colours)]),
            position=self.page.in_scene(tile.origin), cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _save(self, _: object) -> None:
        """Send the mesh to the browser as it is drawn, in the map frame."""
        tiles = [drawn.tile for drawn in list(self._shown.values())]
        mesh = joined_tiles(tiles, self.page.source.sizes.tile_side_m)
        self.page.client.send_file_download(
            "triquad-mesh.glb", mesh.file_bytes(".glb"), save_immediately=True
        )


def cut_tile(tile: MeshTile, top_m: float) -> MeshTile:
    """Return a tile without the faces that reach above a height; all of its vertices stay."""
    below = tile.origin[2] + tile.vertices[:, 2] <= top_m
    return replace(tile, faces=tile.faces[below[tile.faces].all(axis=1)])


def joined_tiles(tiles: Sequence[MeshTile], tile_side_m: float) -> Mesh:
    """Return tiles as one mesh; the side is that of tiles of level 0, metres."""
    zero = tiles[0].origin if tiles else np.zeros(3)
    parts = (Triangles(tile.origin - zero + tile.vertices, tile.faces) for tile in tiles)
    everywhere = np.full(3, -np.inf), np.full(3, np.inf)
    epoch = max((tile.version for tile in tiles), default=0)
    return Mesh.of(joined(parts, tile_side_m, everywhere).moved(zero), epoch)


def _some_vertices(tiles: Iterable[MeshTile]) -> Doubles:
    """Return vertices [N, 3] of all tiles, enough to know where these are; metres, map frame."""
    some = [tile.origin + tile.vertices[:: max(1, len(tile.vertices) // _ENOUGH)] for tile in tiles]
    return np.concatenate([np.zeros((0, 3)), *some])
