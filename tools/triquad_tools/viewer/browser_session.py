"""One browser that looks at the map."""

from collections.abc import Callable
from functools import partial
from typing import Protocol

import viser
from triquad_format.errors import TriquadError

from triquad_tools.viewer.asking.click_layer import ClickLayer
from triquad_tools.viewer.asking.slice_layer import SliceLayer
from triquad_tools.viewer.asking.unknown_layer import UnknownLayer
from triquad_tools.viewer.checkpoints.changes_panel import ChangesPanel
from triquad_tools.viewer.checkpoints.time_panel import TimePanel
from triquad_tools.viewer.live.status_panel import StatusPanel
from triquad_tools.viewer.live.trail_layer import TrailLayer
from triquad_tools.viewer.mesh.mesh_layer import MeshLayer
from triquad_tools.viewer.page.page import Page, SceneOrigin
from triquad_tools.viewer.page.panel_html import problem_html, text_html
from triquad_tools.viewer.page.shown_legends import ShownLegends
from triquad_tools.viewer.picture.screenshot_button import ScreenshotButton
from triquad_tools.viewer.sources.history import History
from triquad_tools.viewer.sources.history_source import HistorySource, newest_of
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.sources.map_source import MapSource


class Layer(Protocol):
    """Draws one thing of a map, and has a folder of the panel, until it is closed."""

    def close(self) -> None:
        """Draw no more; what was drawn and the folder go."""


_LAYERS: tuple[Callable[[Page], Layer], ...] = (
    MeshLayer,
    SliceLayer,
    UnknownLayer,
    ClickLayer,
    ScreenshotButton,
)
_HISTORY_LAYERS: tuple[Callable[[HistorySource, Page], Layer], ...] = (TimePanel, ChangesPanel)
_LIVE_LAYERS: tuple[Callable[[LiveSource, Page], Layer], ...] = (StatusPanel, TrailLayer)


class BrowserSession:
    """The scene and the panel of one browser, from when it opens the page until it leaves."""

    def __init__(self, client: viser.ClientHandle, shown: MapSource | History) -> None:
        client.gui.configure_theme(show_logo=False, show_share_button=False)
        client.gui.main_panel.dock_right()
        client.gui.set_panel_label("triquad")
        client.scene.set_up_direction("+z")
        client.scene.configure_default_lights(cast_shadow=False)
        client.scene.configure_environment_map(None)
        self._title = client.gui.add_html("")
        self._problem = client.gui.add_html("")
        self._client = client
        self._layers: list[Layer] = []
        self._problems: dict[int, str] = {}  # by layer
        self._history: HistorySource | None = None
        try:
            if isinstance(shown, History):
                self._history = newest_of(shown)
                self.show(self._history)
            else:
                self.show(shown)
        except TriquadError as error:
            self._failed(0, str(error))

    def show(self, source: MapSource) -> None:
        """Show another map."""
        self._clear()
        self._title.content = text_html(source.title)
        layers = [*_LAYERS]
        if isinstance(source, HistorySource):
            layers = [*(partial(layer, source) for layer in _HISTORY_LAYERS), *layers]
        if isinstance(source, LiveSource):
            layers += [partial(layer, source) for layer in _LIVE_LAYERS]
        origin, legends = SceneOrigin(), ShownLegends()
        for number, layer in enumerate(layers):
            failed = partial(self._failed, number)
            page = Page(self._client, source, failed, origin=origin, legends=legends)
            self._layers.append(layer(page))

    def close(self) -> None:
        """The browser has left."""
        self._clear()
        if self._history is not None:
            self._history.close()

    def _clear(self) -> None:
        for layer in self._layers:
            layer.close()
        self._layers.clear()
        self._problems.clear()
        self._problem.content = ""

    def _failed(self, layer: int, problem: str) -> None:
        """Show what a layer has met; nothing is left of it where the text is empty."""
        self._problems[layer] = problem
        different = dict.fromkeys(filter(None, self._problems.values()))
        self._problem.content = problem_html("\n".join(different))
