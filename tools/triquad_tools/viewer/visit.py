"""One browser that looks at the map."""

import numpy as np
import viser

from triquad_tools.viewer.map_source import MapSource
from triquad_tools.viewer.mesh_layer import MeshLayer
from triquad_tools.viewer.stage import Stage


class Visit:
    """The scene and the panel of one browser, from when it opens the page until it leaves."""

    def __init__(self, client: viser.ClientHandle, source: MapSource) -> None:
        client.gui.set_panel_label("triquad")
        client.scene.set_up_direction("+z")
        client.scene.configure_default_lights(cast_shadow=False)
        client.scene.configure_environment_map(None)
        self._problem = client.gui.add_markdown("")
        client.gui.add_markdown(f"**{source.title}**")
        self._stage = Stage(client, source, np.zeros(3), self._failed)
        self._mesh = MeshLayer(self._stage)

    def close(self) -> None:
        """The browser has left."""
        self._mesh.close()

    def _failed(self, problem: str) -> None:
        self._problem.content = problem
