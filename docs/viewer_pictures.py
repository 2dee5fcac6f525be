"""Makes the pictures of the viewer: a street that grows, and the page when it is settled.

``python docs/viewer_pictures.py`` takes two minutes on a machine with nothing else to do.
"""

import io
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from pictures import IMAGES, for_pages
from PIL import Image
from playwright.sync_api import Page
from triquad_client import Client
from triquad_server import serve
from triquad_tools.recordings.publishing import wait_until_settled
from triquad_tools.simulation.street import street_drive
from triquad_tools.viewer.sources import LiveSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import opened_page, running_browser, wait_until_drawn

PICTURES = ("viewer.gif", "viewer.png")

_MAP = "street"
_SCANS = 60
_SCAN_PERIOD_S = 0.5
_FRAME_S = 0.75
_FRAMES = 60
_LAST_S = 3.0
_SHOWN = (800, 450)
_COLOURS = 255
_SETTLE_LIMIT_S = 300.0
_WITHOUT_NOTICES = ".mantine-Notifications-root { display: none }"


def main() -> None:
    """Write ``viewer.gif`` and ``viewer.png``."""
    with street_page() as (client, page):
        driving = threading.Thread(target=_drive, args=(client,))
        driving.start()
        frames = list(_film(page))
        driving.join()
        save_film(frames, IMAGES / "viewer.gif")
        wait_until_settled(client, _SETTLE_LIMIT_S)
        page.get_by_label("Show slice").check()
        page.wait_for_timeout(6000)
        settled = Image.open(io.BytesIO(page.screenshot()))
        for_pages(settled).save(IMAGES / "viewer.png", optimize=True)


@contextmanager
def street_page() -> Iterator[tuple[Client, Page]]:
    """A client of a server without a map, and the page of a viewer of it."""
    with (
        serve(map=_MAP) as server,
        server.client() as client,
        closing(Viewer(LiveSource(client, server.endpoint), "127.0.0.1", 0)) as viewer,
        running_browser() as browser,
        opened_page(browser, viewer.url) as page,
    ):
        page.add_style_tag(content=_WITHOUT_NOTICES)
        yield client, page


def _drive(client: Client) -> None:
    """Publish the scans of a street, slowly enough for a browser that draws in software."""
    drive = street_drive(1, _SCANS)
    pause = threading.Event()
    for number in range(_SCANS):
        scan = drive.scan(number)
        client.publish_scan(scan.points, scan.world_from_sensor, source="roof-lidar")
        pause.wait(_SCAN_PERIOD_S)


def _film(page: Page) -> Iterator[Image.Image]:
    wait_until_drawn(page)
    for _ in range(_FRAMES):
        yield Image.open(io.BytesIO(page.screenshot())).convert("RGB").resize(_SHOWN)
        page.wait_for_timeout(1000 * _FRAME_S)


def save_film(frames: list[Image.Image], path: Path) -> None:
    """Write frames as a GIF of as many colours as it needs, which starts anew after a while."""
    palette = frames[-1].quantize(_COLOURS)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    waits_ms = [150] * (len(small) - 1) + [int(1000 * _LAST_S)]
    small[0].save(path, save_all=True, append_images=small[1:], duration=waits_ms, loop=0)


if __name__ == "__main__":
    main()
