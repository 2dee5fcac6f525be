"""What the parts of a page draw on."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats

from triquad_tools.viewer.map_source import MapSource


@dataclass(frozen=True)
class Stage:
    """A scene and a panel in one browser, and the map that they show.

    A browser computes in single precision: positions in the scene are relative to an origin.
    """

    client: viser.ClientHandle
    source: MapSource
    origin: Doubles  # [3] metres, map frame: where the scene has its zero
    failed: Callable[[str], None]  # tells the person what went wrong

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
        return np.asarray(points - self.origin, np.float32)

    def in_map(self, points: NDArray[np.floating]) -> Doubles:
        """Points [..., 3] of the scene in the map frame."""
        return np.asarray(points, np.float64) + self.origin
