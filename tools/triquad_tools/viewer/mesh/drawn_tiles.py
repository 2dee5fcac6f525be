"""The mesh tiles that are in a scene."""

from collections.abc import Hashable, Mapping
from typing import NamedTuple

import viser

from triquad_tools.viewer.mesh.thinning import thinned
from triquad_tools.viewer.mesh.tile_colours import TileColours, lit_colours
from triquad_tools.viewer.mesh.tiles_in_view import TileName, WantedTile
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.unlit_glb import Triangles, unlit_glb
from triquad_tools.viewer.sources.map_source import COARSEST


class _DrawnTile(NamedTuple):
    """What is in the scene for a tile."""

    appearance: Hashable  # where this is another one, what is drawn looks otherwise
    handle: viser.GlbHandle | None  # None: no triangle was left


class DrawnTiles:
    """Draws tiles. What another one replaces goes a round later, so that nothing flickers."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._drawn: dict[TileName, _DrawnTile] = {}
        self._replaced: list[viser.GlbHandle] = []
        self._number = 0  # of the nodes so far: each has a name of its own

    def show(self, wanted: Mapping[TileName, WantedTile], colours: TileColours) -> None:
        """Draw what is wanted and not there yet; what is wanted no more goes a round later."""
        for name, want in wanted.items():
            appearance = (want.tile.version, want.level, type(colours), colours.key(want.tile))
            drawn = self._drawn.get(name)
            if drawn is None or drawn.appearance != appearance:
                handle = self._draw(want, colours)
                self._replace(name)
                self._drawn[name] = _DrawnTile(appearance, handle)
        for name in self._drawn.keys() - wanted.keys():
            self._replace(name)

    def remove_replaced(self) -> None:
        """Remove what the round before replaced."""
        for handle in self._replaced:
            handle.remove()
        self._replaced.clear()

    def clear(self) -> None:
        """Remove all tiles."""
        for name in list(self._drawn):
            self._replace(name)
        self.remove_replaced()

    def _draw(self, want: WantedTile, colours: TileColours) -> viser.GlbHandle | None:
        triangles = Triangles(want.tile.vertices, want.tile.faces)
        if want.level > COARSEST:
            sizes = self._page.source.sizes
            triangles = thinned(triangles, sizes.cell_of(want.level), sizes.side_of(COARSEST))
        if not len(triangles.faces):
            return None
        self._number += 1
        glb = unlit_glb(triangles, lit_colours(colours, want.tile, triangles))
        return self._page.add_glb(f"/mesh/{self._number}", glb, want.tile.origin)

    def _replace(self, name: TileName) -> None:
        drawn = self._drawn.pop(name, None)
        if drawn is not None and drawn.handle is not None:
            self._replaced.append(drawn.handle)
