"""The web server that shows a map, and the page of each browser."""

import io
import socket
import threading
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from typing import Literal

import viser
from triquad_format.errors import TriquadError

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.allowed_origins import serving_only
from triquad_tools.viewer.mesh.mesh_layer import MeshLayer
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.questions.clicks import Clicks
from triquad_tools.viewer.questions.slice import SliceQuestion
from triquad_tools.viewer.questions.unknown_space import UnknownSpace
from triquad_tools.viewer.sources import History, LiveSource, MapSource
from triquad_tools.viewer.time_panel import TimePanel
from triquad_tools.viewer.trail_layer import TrailLayer
from triquad_tools.viewer.view_panel import ViewPanel

_UPRIGHT, _NARROW = 1.0, 1.5  # width to height: how many pixels a screen has says nothing
_OF_ONE_WHO_LEFT = ("Queued a .* on a closed connection", "Attempted to remove an? already removed")
"""Warnings of viser that come when a browser leaves while something is drawn or removed."""


def open_page(client: viser.ClientHandle, shown: MapSource | History) -> ExitStack:
    """Build the page of one browser; return what ends it."""
    _prepare(client)
    page, parts = Page(client), ExitStack()
    try:
        page.source = source = shown.newest() if isinstance(shown, History) else shown
        page.entitle()
        with _controls(client):
            if isinstance(shown, History):
                parts.callback(TimePanel(page, shown).close)
            mesh = MeshLayer(page)
            parts.callback(mesh.close)
            parts.callback(ViewPanel(page, mesh).close)
            for part in (SliceQuestion, UnknownSpace, Clicks):
                parts.callback(part(page).close)
            if isinstance(source, LiveSource):
                parts.callback(TrailLayer(page, source.client, mesh).close)
    except TriquadError as error:
        page.failed("page", str(error))
    except Exception:
        parts.close()
        raise
    return parts


def _controls(client: viser.ClientHandle) -> viser.GuiFolderHandle:
    """Return where controls are; on a page as a phone has it, a folder that is shut at first."""
    upright = client.camera.aspect < _UPRIGHT
    return client.gui.add_folder("Controls" if upright else None, expand_by_default=not upright)


def _prepare(client: viser.ClientHandle) -> None:
    """Make a page plain: the map alone, z upwards."""
    width: Literal["small", "medium"] = "small" if client.camera.aspect < _NARROW else "medium"
    client.gui.configure_theme(control_width=width, show_logo=False, show_share_button=False)
    client.gui.main_panel.dock_right()
    client.gui.set_panel_label("triquad")
    client.scene.set_up_direction("+z")
    client.scene.configure_default_lights(cast_shadow=False)
    client.scene.configure_environment_map(None)
    client.scene.add_light_ambient("/ambient", intensity=2.0)  # no side of what is lit is black


class _OwnServer(viser.ViserServer):
    """A server that refuses what a page may request without its user."""

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Refuse to show the page to the internet: any page's visitor could request that."""
        return None


class Viewer:
    """Serves a page that shows a map, to several browsers, until it is closed."""

    def __init__(
        self, shown: MapSource | History, host: str, port: int, *, allowed_hosts: Sequence[str] = ()
    ) -> None:
        """Serve at an address of this machine, at ``port`` or the next one that is free.

        Pages of other servers cannot use it, but for those of ``allowed_hosts``: names under which
        this machine is reached beyond its host name and its addresses.
        """
        _check_address(host)
        self._shown = shown
        self._sessions: dict[int, ExitStack] = {}  # what ends the page of a browser
        self._closed = False
        self._changing = threading.Lock()
        self._opened = threading.Event()
        for message in _OF_ONE_WHO_LEFT:
            warnings.filterwarnings("ignore", message, UserWarning)
        # The library has announcements of its own.
        with redirect_stdout(io.StringIO()), serving_only(allowed_hosts):
            self._server = _OwnServer(host, port, label="triquad", verbose=False)
        self._server.on_client_connect(self._enter)
        self._server.on_client_disconnect(self._leave)

    @property
    def url(self) -> str:
        """The URL of the page."""
        host = self._server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"

    def wait_for_browser(self) -> None:
        """Wait until a browser has opened the page."""
        self._opened.wait()

    def close(self) -> None:
        """Serve no longer."""
        with self._changing:
            self._closed = True
            sessions = list(self._sessions.values())
            self._sessions.clear()
        for session in sessions:
            session.close()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _enter(self, client: viser.ClientHandle) -> None:
        session = open_page(client, self._shown)
        with self._changing:
            # A browser may leave meanwhile: callbacks run at the same time, in any order.
            left = self._closed or client.client_id not in self._server.get_clients()
            if not left:
                self._sessions[client.client_id] = session
        if left:
            session.close()
        else:
            self._opened.set()

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._changing:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()


def _check_address(host: str) -> None:
    """Refuse an address at which nothing can be served: viser would try for ever."""
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        socket.create_server(address[:2], family=family).close()
    except (OSError, ValueError) as error:
        raise ToolError(
            f"cannot serve a page at {host!r}: {error}; use an address of this machine, such as "
            "127.0.0.1, or 0.0.0.0 for all"
        ) from error
