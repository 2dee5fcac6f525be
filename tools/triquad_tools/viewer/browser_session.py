"""The session of one browser that shows the map."""

from contextlib import ExitStack

import viser
from triquad_format.errors import TriquadError

from triquad_tools.viewer.mesh.mesh_layer import MeshLayer
from triquad_tools.viewer.page.legends import problem_html, text_html
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.questions.clicks import Clicks
from triquad_tools.viewer.questions.slice import SliceQuestion
from triquad_tools.viewer.questions.unknown_space import UnknownSpace
from triquad_tools.viewer.sources.history import History
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.sources.map_source import MapSource
from triquad_tools.viewer.time_panel import TimePanel
from triquad_tools.viewer.trail_layer import TrailLayer


class BrowserSession:
    """The scene and the panel of one browser, from when it opens the page until it leaves."""

    def __init__(self, client: viser.ClientHandle, shown: MapSource | History) -> None:
        self._client = client
        _prepare(client)
        self._title = client.gui.add_html("")
        self._shown_problems = client.gui.add_html("")
        self._problems: dict[str, str] = {}  # by part of the page
        self._parts = ExitStack()
        try:
            self._show(shown)
        except TriquadError as error:
            self._tell("page", str(error))
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """Handle a browser that has left."""
        self._parts.close()

    def _show(self, shown: MapSource | History) -> None:
        """Build the page; of a history, each browser chooses its own moment."""
        source = shown.newest() if isinstance(shown, History) else shown
        self._title.content = text_html(source.title)
        page = Page(self._client, source, self._tell)
        if isinstance(shown, History):
            self._parts.callback(TimePanel(page, shown).close)
        for part in (MeshLayer, SliceQuestion, UnknownSpace, Clicks):
            self._parts.callback(part(page).close)
        if isinstance(source, LiveSource):
            self._parts.callback(TrailLayer(page, source.client).close)

    def _tell(self, part: str, problem: str) -> None:
        """Show the problem of a part; with an empty text it has none any more."""
        self._problems[part] = problem
        different = dict.fromkeys(filter(None, list(self._problems.values())))
        self._shown_problems.content = problem_html("\n".join(different))


def _prepare(client: viser.ClientHandle) -> None:
    """Make a page plain: the map alone, z upwards."""
    client.gui.configure_theme(show_logo=False, show_share_button=False)
    client.gui.main_panel.dock_right()
    client.gui.set_panel_label("triquad")
    client.scene.set_up_direction("+z")
    client.scene.configure_default_lights(cast_shadow=False)
    client.scene.configure_environment_map(None)
    client.scene.add_light_ambient("/ambient", intensity=2.0)  # no side of what is lit is black
