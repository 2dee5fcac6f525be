"""Browsers that come and go, and what they may not ask for."""

import multiprocessing
import threading
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser
from support.browser import opened_page, wait_until
from support.changing_store import EMPTY, write_checkpoint
from support.servers import WAIT_S
from triquad_client import open_map
from triquad_client.checks import Bounds
from triquad_tools.viewer.file_source import FileFollower, FileSource
from triquad_tools.viewer.open_maps import OpenMaps
from triquad_tools.viewer.tile_maker import TileMaker
from triquad_tools.viewer.viewer import Viewer


class SlowSource(FileSource):
    """A map whose tiles are long in coming."""

    def __init__(self, path: Path, maker: TileMaker) -> None:
        super().__init__(open_map(path), path, maker)
        self.asked = threading.Event()
        self.answered = threading.Event()

    def follow(self, level: int, bounds: Bounds | None = None) -> FileFollower:
        self.asked.set()
        assert self.answered.wait(WAIT_S)
        return super().follow(level, bounds)


def layers() -> list[threading.Thread]:
    """The threads of all layers of all pages."""
    return [thread for thread in threading.enumerate() if thread.name in ("mesh", "clicks")]


def test_who_leaves_before_the_page_is_there_leaves_nothing_behind(
    browser: Browser, tmp_path: Path
) -> None:
    with closing(TileMaker()) as maker:
        source = SlowSource(write_checkpoint(tmp_path, 1, EMPTY), maker)
        with (
            closing(source.opened),
            closing(Viewer(source, "127.0.0.1", 0)) as viewer,
            opened_page(browser, viewer.url) as other,
        ):
            with opened_page(browser, viewer.url):
                assert source.asked.wait(WAIT_S)
                wait_until(other, lambda: len(viewer._server.get_clients()) == 2, "both are there")
            wait_until(other, lambda: len(viewer._server.get_clients()) == 1, "one has left")
            source.answered.set()
            wait_until(other, lambda: len(layers()) == 2, "one page is drawn")


def test_nobody_who_reaches_the_page_can_show_it_to_the_internet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(_: object) -> None:
        raise AssertionError("a process for a tunnel is started")

    monkeypatch.setattr(multiprocessing.Process, "start", start)
    path = write_checkpoint(tmp_path, 1, EMPTY)
    with closing(OpenMaps()) as maps, closing(Viewer(maps.use(path), "127.0.0.1", 0)) as viewer:
        viewer._server.request_share_url()  # as a message from a page has it done
