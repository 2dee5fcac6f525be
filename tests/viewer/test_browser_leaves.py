"""A browser that leaves while its page is still made leaves nothing behind."""

import threading
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser
from support.files.changing_store import EMPTY, write_checkpoint
from triquad_client.checks import Bounds
from triquad_tools.viewer.sources.map_source import TileFollower
from triquad_tools.viewer.sources.stored_map import StoredMap, StoredTiles
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import wait_until

asked, may_go_on, closed = threading.Event(), threading.Event(), threading.Event()


class SlowMap(StoredMap):
    """A map whose mesh is to be had only once the test says so."""

    def follow(
        self, level: int, bounds: Bounds | None = None, before: TileFollower | None = None
    ) -> StoredTiles:
        asked.set()
        assert may_go_on.wait(60.0)
        followed = super().follow(level, bounds, before)
        followed.close = closed.set  # type: ignore[method-assign]
        return followed


@pytest.mark.long
def test_a_page_is_closed_that_was_left_before_it_was_made(
    tmp_path: Path, browser: Browser
) -> None:
    shown = SlowMap(write_checkpoint(tmp_path, 1, EMPTY), "file")
    with closing(Viewer(shown, "127.0.0.1", 0)) as viewer, browser.new_page() as other:
        leaving = browser.new_page()
        leaving.goto(viewer.url)
        assert asked.wait(60.0)
        leaving.close()
        server = viewer._server  # nothing else tells whom it still knows
        wait_until(other, lambda: not server.get_clients(), "it is known that it left")
        may_go_on.set()
        assert closed.wait(60.0)
