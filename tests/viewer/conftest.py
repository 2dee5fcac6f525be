"""A browser for all tests of a module, and pages that show a map."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import triquad_client
from playwright.sync_api import Browser, Page, expect
from support.browser import running_browser
from triquad_tools.viewer.sources.history import History
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.sources.stored_source import StoredMap, StoredSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import opened_page

expect.set_options(timeout=60_000)  # a browser that draws in software takes seconds at times


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture
def page_without_server(browser: Browser) -> Iterator[Callable[[Path], Page]]:
    """Opens the page of a viewer of a map file, or of a store."""
    with ExitStack() as opened:

        def open_viewer(path: Path) -> Page:
            shown = History(path) if path.is_dir() else StoredSource(StoredMap(path), path.name)
            viewer = Viewer(shown, "127.0.0.1", 0)
            opened.callback(viewer.close)
            return opened.enter_context(opened_page(browser, viewer.url))

        yield open_viewer


@pytest.fixture
def page_of(browser: Browser) -> Iterator[Callable[[str], Page]]:
    """Opens the page of a viewer of the server at an endpoint."""
    with ExitStack() as opened:

        def open_viewer(endpoint: str) -> Page:
            client = opened.enter_context(triquad_client.connect(endpoint))
            viewer = Viewer(LiveSource(client, endpoint), "127.0.0.1", 0)
            opened.callback(viewer.close)
            return opened.enter_context(opened_page(browser, viewer.url))

        yield open_viewer
