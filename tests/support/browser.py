"""A real browser for tests, which skip where there is none."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser
from triquad_tools.console.command import ToolError

from bench.clients import browser


@contextmanager
def running_browser() -> Iterator[Browser]:
    """Chromium; the test is skipped where it is not installed."""
    try:
        browser.installed()
    except ToolError as missing:
        pytest.skip(str(missing))
    with browser.running_browser() as running:
        yield running
