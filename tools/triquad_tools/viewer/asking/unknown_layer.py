"""Where unknown space begins, in a scene."""

import numpy as np
import viser
from matplotlib.colors import to_rgb
from triquad_map.height_scale import GAMMA

from triquad_tools.viewer.asking.questions import Pace, newest_epoch
from triquad_tools.viewer.asking.unknown_boundary import (
    Boundary,
    CellBox,
    ask_boundary,
    face_triangles,
)
from triquad_tools.viewer.page.focus import focus_of
from triquad_tools.viewer.page.legends import Legend, LineMeaning
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.panel_html import text_html
from triquad_tools.viewer.page.refresher import Refresher
from triquad_tools.viewer.page.unlit_glb import unlit_glb

_PERIOD_S = 1.0
_COLOUR_HEX = "#cc79a7"
_LEGEND = Legend(lines=(LineMeaning(_COLOUR_HEX, False, "between free and unknown space"),))
_NAME = "unknown space"
_COLOUR = np.array(to_rgb(_COLOUR_HEX))
_SHADES = np.array([0.8, 0.65, 1.0])  # of faces across x, y and z: else no edge would be seen
_OPACITY = 0.4
_VOXEL_CELLS = 2  # a cell of the mesh is half a voxel, as fine as what is known is told


class UnknownLayer:
    """Draws the boundary of free against unknown space around what the camera looks at."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._pace = Pace()
        self._drawn: CellBox | None = None
        self._epoch = 0
        self._surface: viser.GlbHandle | None = None
        self._folder = page.gui.add_folder("Unknown space")
        with self._folder:
            self._shown = page.gui.add_checkbox("Show border", False)
            self._legend = page.gui.add_html("", visible=False)
        self._refresher = Refresher(
            "unknown space", self._refresh, period_s=_PERIOD_S, failed=page.failed
        )
        self._shown.on_update(lambda _: self._refresher.wake())

    def close(self) -> None:
        """Draw no more; what was drawn and the folder go."""
        self._refresher.close()
        self._erase()
        self._folder.remove()

    def _refresh(self) -> None:
        self._legend.visible = self._shown.value
        if not self._shown.value:
            self._erase()
            return
        source = self._page.source
        box = CellBox.around(focus_of(self._page), _VOXEL_CELLS * source.sizes.cell_m)
        if box != self._drawn or (self._pace.due and newest_epoch(source.queries) != self._epoch):
            with self._pace.asking():
                boundary = ask_boundary(source.queries, box)
            self._draw(box, boundary)

    def _draw(self, box: CellBox, boundary: Boundary) -> None:
        self._erase()
        if len(boundary.faces.cells):
            triangles = face_triangles(boundary.faces)
            shades = _COLOUR * _SHADES[np.abs(boundary.faces.steps).argmax(axis=1), None]
            glb = unlit_glb(triangles, shades.repeat(4, axis=0) ** GAMMA, _OPACITY)
            corner = np.array(box.corner)
            self._surface = self._page.add_glb("/unknown", glb, corner, scale=box.cell_m)
        self._legend.content = _LEGEND.html + text_html(_extent(box, boundary))
        self._page.legends.show(_NAME, _LEGEND)
        self._drawn, self._epoch = box, boundary.epoch

    def _erase(self) -> None:
        if self._surface is not None:
            self._surface.remove()
        self._surface = self._drawn = None
        self._page.legends.hide(_NAME)


def _extent(box: CellBox, boundary: Boundary) -> str:
    wide, high = box.size_m
    return (
        f"{wide:.3g} x {wide:.3g} x {high:.3g} m around the middle of the view, "
        f"in cells of {box.cell_m:.2g} m; epoch {boundary.epoch}"
    )
