"""A page: one scene and one panel in one browser, and where the scene has its zero."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats

from triquad_tools.viewer.page.legends import ShownLegends
from triquad_tools.viewer.sources.map_source import MapSource

_GRID_M = 100.0


class SceneOrigin:
    """Where in the map frame a scene has its zero: near the first point that is drawn.

    A browser computes in single precision, half a metre where coordinates are as large as UTM
    northings.
    """

    def __init__(self) -> None:
        self._place: Doubles | None = None
        self._choosing = threading.Lock()

    @property
    def place(self) -> Doubles:
        """[3] metres, map frame; zero as long as nothing was drawn."""
        return np.zeros(3) if self._place is None else self._place

    def near(self, points: NDArray[np.floating]) -> Doubles:
        """The place, chosen beside ``points`` [..., 3] where there is none yet."""
        with self._choosing:
            if self._place is None and points.size:
                first = np.asarray(points, np.float64).reshape(-1, 3)[0]
                self._place = np.round(first / _GRID_M) * _GRID_M
            return self.place

    def in_scene(self, points: NDArray[np.floating]) -> Floats:
        """Points [..., 3] of the map frame as the scene has them."""
        return np.asarray(points - self.near(points), np.float32)


@dataclass(frozen=True)
class Page:
    """What each part of a page draws on: a scene, the panel beside it, and the map they show."""

    client: viser.ClientHandle
    source: MapSource
    failed: Callable[[str], None]  # shows what went wrong; an empty text: nothing does any more
    origin: SceneOrigin
    legends: ShownLegends

    @property
    def scene(self) -> viser.SceneApi:
        """What is drawn."""
        return self.client.scene

    @property
    def gui(self) -> viser.GuiApi:
        """The panel beside it."""
        return self.client.gui

    def in_scene(self, points: NDArray[np.floating]) -> Floats:
        """Points [..., 3] of the map frame as the scene has them."""
        return self.origin.in_scene(points)

    def add_glb(
        self, name: str, glb: bytes, origin: NDArray[np.floating], scale: float = 1.0
    ) -> viser.GlbHandle:
        """Draw a mesh whose zero is ``origin`` [3], metres, map frame; without shadows."""
        return self.scene.add_glb(
            name,
            glb,
            scale=scale,
            position=self.in_scene(origin),
            cast_shadow=False,
            receive_shadow=False,
        )

    def in_map(self, points: NDArray[np.floating]) -> Doubles:
        """Points [..., 3] of the scene in the map frame."""
        return np.asarray(points, np.float64) + self.origin.place
