"""Who may wait for tiles, where too many do."""

import queue
from contextlib import closing

import numpy as np
import pytest
from support import servers
from triquad_format.wire.messages import TileUpdatesRequest
from triquad_server.epochs.history import EpochHistory
from triquad_server.fair_queue import Owner
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh import tile_feed
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.process.threads import Teams

LIMIT = 4


class PendingRequest:
    """Stands for a Zenoh query; keeps its one answer."""

    size = 100

    def __init__(self, owner, known=0):
        self.owner = Owner(owner)
        self._known = known
        self._replies = queue.SimpleQueue()

    def read(self, _kind):
        return TileUpdatesRequest(
            minimum=np.full(3, 1000.0),
            maximum=np.full(3, 1001.0),
            level=0,
            server="",
            revision=0,
            known=np.arange(3 * self._known, dtype=np.int32).reshape(-1, 3),
            known_versions=np.ones(self._known, np.int64),
            max_bytes=1_000_000,
            timeout_s=60.0,
            client="anybody",
            max_bytes_per_s=0,
        )

    def answer(self, message):
        self._replies.put(message)

    def refuse(self, code, text):
        self._replies.put(code)

    def fail(self, error):
        self.refuse("internal", str(error))

    @property
    def reply(self):
        return self._replies.get(timeout=servers.WAIT_S)

    @property
    def waits(self):
        return self._replies.empty()


@pytest.fixture
def feed(monkeypatch):
    monkeypatch.setattr(TileFeed, "_serve_safely", lambda *_: False)  # all wait
    settings, teams = servers.SMALL, Teams()
    epochs = EpochHistory(Mapper("m", settings, "cpu", teams=teams).publish(), settings.service)
    cache = TileCache(settings.mesh, teams.meshing)
    feed = TileFeed(cache, epochs, server="s", settings=settings.mesh, limit=LIMIT)
    with closing(teams), closing(feed):
        yield feed


def test_who_follows_too_often_is_refused_and_no_other(feed):
    greedy = [PendingRequest("greedy") for _ in range(LIMIT)]
    honest = PendingRequest("honest")
    for request in (*greedy, honest):
        feed.add(request)
    assert greedy[-1].reply == "busy"
    assert honest.waits
    assert all(request.waits for request in greedy[:-1])


def test_who_names_too_many_tiles_is_refused_and_no_other(feed, monkeypatch):
    monkeypatch.setattr(tile_feed, "MAX_HELD_BYTES", 100_000)
    greedy = [PendingRequest("greedy", known=150) for _ in range(2)]
    honest = [PendingRequest("honest") for _ in range(2)]
    for request in (*greedy, *honest):
        feed.add(request)
    assert greedy[-1].reply == "busy"
    assert greedy[0].waits
    assert all(request.waits for request in honest)
