"""One browser that looks at the map."""

from collections.abc import Callable
from contextlib import ExitStack, closing
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
from triquad_tools.viewer.page.legends import ShownLegends
from triquad_tools.viewer.page.page import Page, SceneOrigin
from triquad_tools.viewer.page.panel_html import text_html
from triquad_tools.viewer.page.shown_problems import ShownProblems
from triquad_tools.viewer.picture.screenshot_button import ScreenshotButton
from triquad_tools.viewer.sources.history import History
from triquad_tools.viewer.sources.history_source import HistorySource, newest_of
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.sources.map_source import MapSource


class PagePart(Protocol):
    """Shows one thing of a map in scene and panel, until it is closed."""

    def close(self) -> None:
        """Show no more; what was drawn and its controls go."""


_PARTS: tuple[Callable[[Page], PagePart], ...] = (
    MeshLayer,
    SliceLayer,
    UnknownLayer,
    ClickLayer,
    ScreenshotButton,
)
_HISTORY_PARTS: tuple[Callable[[HistorySource, Page], PagePart], ...] = (TimePanel, ChangesPanel)
_LIVE_PARTS: tuple[Callable[[LiveSource, Page], PagePart], ...] = (StatusPanel, TrailLayer)


class BrowserSession:
    """The scene and the panel of one browser, from when it opens the page until it leaves."""

    def __init__(self, client: viser.ClientHandle, shown: MapSource | History) -> None:
        self._client = client
        _prepare(client)
        self._title = client.gui.add_html("")
        self._problems = ShownProblems(client.gui.add_html(""))
        self._opened = ExitStack()
        try:
            self._show(self._source_of(shown))
        except TriquadError as error:
            self._problems.tell("page", str(error))
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """The browser has left."""
        self._opened.close()

    def _source_of(self, shown: MapSource | History) -> MapSource:
        """What the page shows: of a history, each browser chooses its own moment."""
        if isinstance(shown, History):
            return self._opened.enter_context(closing(newest_of(shown)))
        return shown

    def _show(self, source: MapSource) -> None:
        self._title.content = text_html(source.title)
        parts = [*_PARTS]
        if isinstance(source, HistorySource):
            parts = [*(partial(part, source) for part in _HISTORY_PARTS), *parts]
        if isinstance(source, LiveSource):
            parts += [partial(part, source) for part in _LIVE_PARTS]
        origin, legends = SceneOrigin(), ShownLegends()
        for number, part in enumerate(parts):
            failed = partial(self._problems.tell, f"part {number}")
            page = Page(self._client, source, failed, origin=origin, legends=legends)
            self._opened.callback(part(page).close)


def _prepare(client: viser.ClientHandle) -> None:
    """Make a page plain: the map alone, lit from nowhere, z upwards."""
    client.gui.configure_theme(show_logo=False, show_share_button=False)
    client.gui.main_panel.dock_right()
    client.gui.set_panel_label("triquad")
    client.scene.set_up_direction("+z")
    client.scene.configure_default_lights(cast_shadow=False)
    client.scene.configure_environment_map(None)
