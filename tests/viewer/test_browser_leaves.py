"""A browser that leaves while its page is still made leaves nothing behind."""

import threading
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser
from support.changing_store import EMPTY, write_checkpoint
from triquad_client.checks import Bounds
from triquad_tools.viewer.sources.stored_source import StoredFollower, StoredMap, StoredSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import wait_until


class SlowSource(StoredSource):
    """A map whose mesh is to be had only once the test says so."""

    asked = threading.Event()
    may_go_on = threading.Event()
    closed = threading.Event()

    def follow(self, level: int, bounds: Bounds | None = None) -> StoredFollower:
        self.asked.set()
        assert self.may_go_on.wait(60.0)
        return TellingFollower(self, level, bounds)


class TellingFollower(StoredFollower):
    def close(self) -> None:
        SlowSource.closed.set()


@pytest.mark.long
def test_a_page_is_closed_that_was_left_before_it_was_made(
    tmp_path: Path, browser: Browser
) -> None:
    source = SlowSource(StoredMap(write_checkpoint(tmp_path, 1, EMPTY)), "file")
    with closing(Viewer(source, "127.0.0.1", 0)) as viewer, browser.new_page() as other:
        leaving = browser.new_page()
        leaving.goto(viewer.url)
        assert source.asked.wait(60.0)
        leaving.close()
        server = viewer._server  # nothing else tells whom it still knows
        wait_until(other, lambda: not server.get_clients(), "it is known that it left")
        source.may_go_on.set()
        assert source.closed.wait(60.0)
