"""A browser for all tests of a module, and pages that show a map."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager

import pytest
from playwright.sync_api import Browser, Page, expect
from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources import History, MapSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients import browser

expect.set_options(timeout=60_000)  # a browser that draws in software takes seconds at times

Show = Callable[[MapSource | History], AbstractContextManager[Page]]
"""Opens the page of a viewer of a map."""


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """A browser; tests skip where there is none."""
    try:
        browser.installed()
    except ToolError as missing:
        pytest.skip(str(missing))
    with browser.running_browser() as running:
        yield running


@pytest.fixture(scope="module")
def show(chromium: Browser) -> Show:
    @contextmanager
    def opened(shown: MapSource | History) -> Iterator[Page]:
        with (
            closing(Viewer(shown, "127.0.0.1", 0)) as viewer,
            browser.opened_page(chromium, viewer.url) as page,
        ):
            yield page

    return opened
