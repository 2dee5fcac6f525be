"""A browser that leaves while its page is still made leaves nothing behind."""

import threading
from contextlib import closing
from pathlib import Path

from playwright.sync_api import Browser
from support.changing_store import EMPTY, write_checkpoint
from triquad_client.checks import Bounds
from triquad_tools.viewer.sources.file_source import FileFollower, FileSource
from triquad_tools.viewer.sources.open_maps import OpenMaps
from triquad_tools.viewer.sources.tile_maker import TileMaker, TileOrder
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import wait_until


class SlowSource(FileSource):
    """A map whose mesh is to be had only once the test says so."""

    asked = threading.Event()
    may_go_on = threading.Event()

    def follow(self, level: int, bounds: Bounds | None = None) -> FileFollower:
        self.asked.set()
        assert self.may_go_on.wait(60.0)
        return super().follow(level, bounds)


class TellingMaker(TileMaker):
    """Tells when nobody wants its tiles any more."""

    cancelled = threading.Event()

    def cancel(self, order: TileOrder) -> None:
        super().cancel(order)
        self.cancelled.set()


def test_a_page_is_closed_that_was_left_before_it_was_made(
    tmp_path: Path, browser: Browser
) -> None:
    path = write_checkpoint(tmp_path, 1, EMPTY)
    with closing(OpenMaps()) as maps, closing(TellingMaker()) as maker:
        source = SlowSource(maps.use(path).opened, path, maker)
        with closing(Viewer(source, "127.0.0.1", 0)) as viewer, browser.new_page() as other:
            leaving = browser.new_page()
            leaving.goto(viewer.url)
            assert source.asked.wait(60.0)
            leaving.close()
            server = viewer._server  # nothing else tells whom it still knows
            wait_until(other, lambda: not server.get_clients(), "it is known that it left")
            source.may_go_on.set()
            assert maker.cancelled.wait(60.0)
