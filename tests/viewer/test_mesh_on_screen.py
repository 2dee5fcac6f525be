"""What a browser shows of the mesh of a server."""

from collections.abc import Iterator

import numpy as np
import pytest
import triquad_client
from playwright.sync_api import Browser
from support import servers
from support.browser import opened_page, picture, running_browser
from triquad_tools.viewer.live_source import LiveSource
from triquad_tools.viewer.viewer import Viewer


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


def drawn_share(pixels: np.ndarray) -> float:
    """Share of pixels that are not the background, left of the panel."""
    scene = pixels[:, : pixels.shape[1] // 2]
    return float((scene.min(axis=-1) < 200).mean())


def test_a_mesh_appears_once_there_is_one(browser: Browser) -> None:
    with (
        servers.running_service() as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        viewer = Viewer(LiveSource(client, endpoint), "127.0.0.1", 0)
        try:
            with opened_page(browser, viewer.url) as page:
                page.wait_for_selector("canvas")
                assert drawn_share(picture(page)) < 0.05
                servers.learn(client)
                page.wait_for_timeout(1000)
                deadline = 60
                while drawn_share(picture(page)) < 0.02 and deadline > 0:
                    page.wait_for_timeout(500)
                    deadline -= 1
                assert drawn_share(picture(page)) > 0.02
        finally:
            viewer.close()
