"""What nobody who reaches a page may ask of its server."""

import multiprocessing
from contextlib import closing
from pathlib import Path

import pytest
from support.changing_store import EMPTY, write_checkpoint
from triquad_tools.viewer.sources.open_maps import OpenMaps
from triquad_tools.viewer.viewer import Viewer


def test_nobody_who_reaches_the_page_can_show_it_to_the_internet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(_: object) -> None:
        raise AssertionError("a process for a tunnel is started")

    monkeypatch.setattr(multiprocessing.Process, "start", start)
    path = write_checkpoint(tmp_path, 1, EMPTY)
    with closing(OpenMaps()) as maps, closing(Viewer(maps.use(path), "127.0.0.1", 0)) as viewer:
        viewer._server.request_share_url()  # as a message from a page has it done
