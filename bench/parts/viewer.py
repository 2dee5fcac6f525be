"""How soon and how smoothly the viewer shows a map."""

import argparse
import statistics
import time
from contextlib import closing

from playwright.sync_api import Browser, Page
from triquad_tools.recordings.publishing import wait_until_settled
from triquad_tools.viewer.sources import LiveSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import opened_page, running_browser, wait_until_drawn
from bench.clients.served import served, stream
from bench.figures import Figure
from bench.street import bench_street

_ROUNDS = 5
_SETTLE_LIMIT_S = 300.0
_DRAWN_S = 4.0
_TURN_PIXELS = 240
_WHEEL_TURNS, _WHEEL = 30, 240
_MIDDLE = (480, 360)  # of the scene

_FRAMES = """
seconds => new Promise(done => {
  let frames = 0
  const began = performance.now()
  const each = now => {
    frames += 1
    if (now - began > 1000 * seconds) done(1000 * frames / (now - began))
    else requestAnimationFrame(each)
  }
  requestAnimationFrame(each)
})
"""


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of the viewer, in a browser that draws in software on the same two cores."""
    with served() as server:
        stream(server.client, bench_street(options.seed).scans)
        wait_until_settled(server.client, _SETTLE_LIMIT_S)
        with (
            closing(Viewer(LiveSource(server.client, ""), "127.0.0.1", 0)) as viewer,
            running_browser() as browser,
        ):
            return [_first_mesh(browser, viewer.url), *_frames(browser, viewer.url)]


def _first_mesh(browser: Browser, url: str) -> Figure:
    """Return how soon a page shows the mesh of a street that is learnt completely."""
    times: list[float] = []
    for _ in range(_ROUNDS):
        started = time.monotonic()
        with opened_page(browser, url) as page:
            wait_until_drawn(page)
            times.append(time.monotonic() - started)
    return Figure("first mesh on the screen", statistics.median(times), "s", at_most=3)


def _frames(browser: Browser, url: str) -> list[Figure]:
    """Return the frames per second of the street, while the camera turns."""
    with opened_page(browser, url) as page:
        wait_until_drawn(page)
        time.sleep(_DRAWN_S)
        whole = _frames_per_second(page)
        page.mouse.move(*_MIDDLE)
        for _ in range(_WHEEL_TURNS):
            page.mouse.wheel(0, -_WHEEL)
            page.wait_for_timeout(50)
        time.sleep(2 * _DRAWN_S)  # the fine tiles come
        near = _frames_per_second(page)
    return [
        Figure("frames of the street, all in view", whole, "a second", at_least=20),
        Figure("the same, near the ground", near, "a second", at_least=20),
    ]


def _frames_per_second(page: Page) -> float:
    page.evaluate("window.counted = undefined")
    page.evaluate(f"window.frames_s = ({_FRAMES})({_DRAWN_S}).then(f => window.counted = f)")
    page.mouse.move(*_MIDDLE)
    page.mouse.down()
    for step in range(_TURN_PIXELS):
        page.mouse.move(_MIDDLE[0] + step, _MIDDLE[1])
        page.wait_for_timeout(1000 * _DRAWN_S / _TURN_PIXELS)
    page.mouse.up()
    page.wait_for_function("window.counted !== undefined")
    return float(page.evaluate("window.counted"))
