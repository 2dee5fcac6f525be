"""How soon and how smoothly the viewer shows a map."""

import statistics
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from playwright.sync_api import Page
from triquad_client import Client
from triquad_client.calls.queries import MapQueries
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import MeshTile, TileIndex
from triquad_tools.recordings.publishing import wait_until_settled
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.sources.map_source import COARSEST, TileFollower, TileSizes
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import opened_page, running_browser, wait_until_drawn
from bench.clients.served import served, stream
from bench.figures import Figure
from bench.street import BenchStreet

_ROUNDS = 5
_SETTLE_LIMIT_S = 300.0
_COPIES, _COPIED_TILES = 20, 4  # of the coarsest level: 2 km of 102.4 m each
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


def measure_viewer(made: BenchStreet) -> list[Figure]:
    """Return figures of the viewer, in a browser that draws in software on the same two cores."""
    with served() as server:
        stream(server.client, made.scans)
        wait_until_settled(server.client, _SETTLE_LIMIT_S)
        return _first_mesh(server.client) + _long_street(server.client)


def _first_mesh(client: Client) -> list[Figure]:
    """Return how soon a page shows the mesh of a street that is learnt completely."""
    times: list[float] = []
    with (
        closing(Viewer(LiveSource(client, ""), "127.0.0.1", 0)) as viewer,
        running_browser() as browser,
    ):
        for _ in range(_ROUNDS):
            started = time.monotonic()
            with opened_page(browser, viewer.url) as page:
                wait_until_drawn(page)
                times.append(time.monotonic() - started)
    return [Figure("first mesh on the screen", statistics.median(times), "s", at_most=3)]


def _long_street(client: Client) -> list[Figure]:
    """Return the frames per second of 2 km of streets, while the camera turns."""
    source = RepeatedSource.of_street(client)
    with (
        closing(Viewer(source, "127.0.0.1", 0)) as viewer,
        running_browser() as browser,
        opened_page(browser, viewer.url) as page,
    ):
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
        Figure("frames of 2 km of street, all in view", whole, "a second", at_least=20),
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


@dataclass(frozen=True)
class RepeatedFollower:
    """The tiles of one street, repeated along x, all there at once."""

    tiles: Mapping[TileIndex, MeshTile]
    complete: bool = True

    def next(self, timeout_s: float) -> None:
        """Do nothing: no tile changes."""

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


@dataclass(frozen=True)
class RepeatedSource:
    """A long street, made of a short one."""

    queries: MapQueries
    sizes: TileSizes
    followers: Mapping[int, RepeatedFollower]
    title: str = "2 km of street"
    grows: bool = False

    @classmethod
    def of_street(cls, client: Client) -> "RepeatedSource":
        """Return the street that a server has."""
        live = LiveSource(client, "")
        followers = {}
        for level in range(COARSEST + 1):
            with client.watch_mesh(level=level) as watch:
                watch.catch_up()
                followers[level] = RepeatedFollower(
                    _repeated(watch.tiles, level, watch.tile_side_m)
                )
        return cls(client, live.sizes, followers)

    def follow(
        self,
        level: int,
        bounds: Bounds | None = None,  # noqa: ARG002
        before: TileFollower | None = None,  # noqa: ARG002
    ) -> RepeatedFollower:
        """Return all tiles of a level: more than requested do no harm."""
        return self.followers[level]


def _repeated(
    tiles: Mapping[TileIndex, MeshTile], level: int, side_m: float
) -> dict[TileIndex, MeshTile]:
    """Return the tiles of a level that lie in the piece that is copied, with their copies."""
    count = _COPIED_TILES << (COARSEST - level)
    step_m = np.array([count * side_m, 0.0, 0.0])
    return {
        (x + copy * count, y, z): replace(tile, origin=tile.origin + copy * step_m)
        for (x, y, z), tile in tiles.items()
        if 0 <= x < count
        for copy in range(_COPIES)
    }
