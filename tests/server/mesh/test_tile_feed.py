"""Who may wait for tiles, where too many do."""

from contextlib import closing

import pytest
from support import servers
from support.requests import PendingRequest, held_tile_updates
from triquad_server.epochs.history import EpochHistory
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh import tile_feed
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.process.threads import Teams

LIMIT = 4


def pending(owner: str, known: int = 0) -> PendingRequest:
    return PendingRequest(held_tile_updates(known, timeout_s=60.0), owner)


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
    greedy = [pending("greedy") for _ in range(LIMIT)]
    honest = pending("honest")
    for request in (*greedy, honest):
        feed.add(request)
    assert greedy[-1].reply == "busy"
    assert honest.waits
    assert all(request.waits for request in greedy[:-1])


def test_who_names_too_many_tiles_is_refused_and_no_other(feed, monkeypatch):
    monkeypatch.setattr(tile_feed, "MAX_HELD_BYTES", 100_000)
    greedy = [pending("greedy", known=150) for _ in range(2)]
    honest = [pending("honest") for _ in range(2)]
    for request in (*greedy, *honest):
        feed.add(request)
    assert greedy[-1].reply == "busy"
    assert greedy[0].waits
    assert all(request.waits for request in honest)
