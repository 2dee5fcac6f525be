"""A slice in a scene: a picture of its distances, lines at round ones, and their numbers."""

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from triquad_tools.viewer.asking.contours import Contour, contours, numbers
from triquad_tools.viewer.asking.distance_scale import distance_colours
from triquad_tools.viewer.asking.slice_plane import Slice, SlicePlane
from triquad_tools.viewer.page.page import Page

_FINER = 4  # pixels along a cell: the browser blurs no more than their borders
_LIFT = 1 / 800  # of the width: lines lie on both sides, before the picture from both sides
_LINE_PIXELS, _SURFACE_PIXELS = 1.5, 4.0
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)


class SliceDrawing:
    """What is drawn for a slice, until it is erased."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._plane: SlicePlane | None = None
        self._picture: viser.ImageHandle | None = None
        self._marks: list[viser.LineSegmentsHandle | viser.LabelHandle] = []

    def draw(self, answer: Slice, max_distance_m: float) -> None:
        """Draw a slice in the place of what is there."""
        colours = distance_colours(answer.distance_m, answer.known, max_distance_m)
        image = colours.repeat(_FINER, axis=0).repeat(_FINER, axis=1)
        lines = contours(answer, max_distance_m)
        with self._page.client.atomic():
            self._draw_picture(answer.plane, image)
            self._remove_marks()
            self._draw_lines(answer.plane, lines)
            self._draw_numbers(answer.plane, lines)

    def erase(self) -> None:
        """Draw it no more."""
        self._remove_marks()
        if self._picture is not None:
            self._picture.remove()
            self._picture = self._plane = None

    def _draw_picture(self, plane: SlicePlane, image: NDArray[np.uint8]) -> None:
        """The same node where only its colours change: a new one is white until it is decoded."""
        if self._picture is not None and plane == self._plane:
            self._picture.image = image
            return
        self._picture = self._page.scene.add_image(
            "/slice/picture",
            image,
            *plane.size_m,
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            wxyz=SO3.from_matrix(plane.axes).wxyz,
            position=self._page.in_scene(plane.middle()),
        )
        self._plane = plane

    def _draw_lines(self, plane: SlicePlane, lines: list[Contour]) -> None:
        surface = [line.pieces for line in lines if line.level_m == 0]
        others = [line.pieces for line in lines if line.level_m > 0]
        self._add_lines("lines", others, plane, colour=_WHITE, pixels=_LINE_PIXELS)
        self._add_lines("surface", surface, plane, colour=_BLACK, pixels=_SURFACE_PIXELS)

    def _add_lines(
        self,
        name: str,
        pieces: list[NDArray[np.float64]],
        plane: SlicePlane,
        *,
        colour: tuple[int, int, int],
        pixels: float,
    ) -> None:
        if not pieces:
            return
        across = _LIFT * plane.size_m[0] * plane.axes[:, 2]
        flat = np.concatenate(pieces)
        handle = self._page.scene.add_line_segments(
            f"/slice/{name}",
            self._page.in_scene(np.concatenate([flat - across, flat + across])),
            colour,
            thickness=pixels,
            thickness_units="screen",
        )
        self._marks.append(handle)

    def _draw_numbers(self, plane: SlicePlane, lines: list[Contour]) -> None:
        for row, number in enumerate(numbers(lines, plane.size_m[0])):
            label = self._page.scene.add_label(
                f"/slice/numbers/{row}",
                f"{number.level_m:g} m",
                position=self._page.in_scene(number.place),
                font_screen_scale=0.8,
                anchor="center-center",
            )
            self._marks.append(label)

    def _remove_marks(self) -> None:
        for mark in self._marks:
            mark.remove()
        self._marks.clear()
