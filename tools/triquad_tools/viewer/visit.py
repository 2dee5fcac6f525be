"""One browser that looks at the map."""

from collections.abc import Callable
from typing import Protocol

import viser

from triquad_tools.viewer.asking.click_layer import ClickLayer
from triquad_tools.viewer.asking.slice_layer import SliceLayer
from triquad_tools.viewer.asking.unknown_layer import UnknownLayer
from triquad_tools.viewer.map_source import MapSource
from triquad_tools.viewer.mesh_layer import MeshLayer
from triquad_tools.viewer.stage import Stage


class Layer(Protocol):
    """Draws one thing of a map, and has a folder of the panel, until it is closed."""

    def close(self) -> None:
        """Draw no more; what was drawn and the folder go."""


_LAYERS: tuple[Callable[[Stage], Layer], ...] = (MeshLayer, SliceLayer, UnknownLayer, ClickLayer)


class Visit:
    """The scene and the panel of one browser, from when it opens the page until it leaves."""

    def __init__(self, client: viser.ClientHandle, source: MapSource) -> None:
        client.gui.set_panel_label("triquad")
        client.scene.set_up_direction("+z")
        client.scene.configure_default_lights(cast_shadow=False)
        client.scene.configure_environment_map(None)
        self._title = client.gui.add_markdown("")
        self._problem = client.gui.add_markdown("")
        self._client = client
        self._layers: list[Layer] = []
        self.show(source)

    def show(self, source: MapSource) -> None:
        """Show another map."""
        self._clear()
        self._title.content = f"**{source.title}**"
        stage = Stage(self._client, source, self._failed)
        self._layers = [layer(stage) for layer in _LAYERS]

    def close(self) -> None:
        """The browser has left."""
        self._clear()

    def _clear(self) -> None:
        for layer in self._layers:
            layer.close()
        self._layers = []

    def _failed(self, problem: str) -> None:
        self._problem.content = problem
