"""Who may wait for tiles, where too many do."""

import math
import threading
from contextlib import closing

import pytest
from support import servers
from support.requests import PendingRequest, held_tile_updates
from triquad_format.wire.mesh_messages import TileUpdates
from triquad_map.compiled.team import Team
from triquad_server.epochs.history import EpochHistory
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh import followers, tile_feed
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.process.threads import Teams
from triquad_server.settings import MeshSettings

LIMIT = 4


def pending(owner: str, known: int = 0) -> PendingRequest:
    return PendingRequest(held_tile_updates(known, timeout_s=60.0), owner)


@pytest.fixture
def feed(monkeypatch):
    monkeypatch.setattr(TileFeed, "_serve_safely", lambda *_: math.inf)  # all wait
    settings, teams = servers.SMALL, Teams()
    epochs = EpochHistory(Mapper("m", settings, "cpu", teams=teams).publish(), settings.service)
    cache = TileCache(settings.mesh, teams.meshing)
    feed = TileFeed(cache, epochs, server="s", limit=LIMIT)
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
    monkeypatch.setattr(followers, "MAX_PENDING_BYTES", 100_000)
    greedy = [pending("greedy", known=150) for _ in range(2)]
    honest = [pending("honest") for _ in range(2)]
    for request in (*greedy, *honest):
        feed.add(request)
    assert greedy[-1].reply == "busy"
    assert greedy[0].waits
    assert all(request.waits for request in honest)


class WatchedCache(TileCache):
    """Notifies of when it lets go."""

    def __init__(self, settings: MeshSettings, team: Team) -> None:
        super().__init__(settings, team)
        self.released = threading.Event()

    def release(self) -> None:
        super().release()
        self.released.set()


def test_an_epoch_is_kept_for_those_who_follow_alone(monkeypatch):
    monkeypatch.setattr(tile_feed, "_KEPT_S", 0.01)
    monkeypatch.setattr(tile_feed, "_REFRESH_PERIOD_S", 0.1)
    settings, teams = servers.SMALL, Teams()
    epochs = EpochHistory(Mapper("m", settings, "cpu", teams=teams).publish(), settings.service)
    cache = WatchedCache(settings.mesh, teams.meshing)
    feed = TileFeed(cache, epochs, server="s", limit=LIMIT)
    with closing(teams), closing(feed):
        for _ in range(2):
            cache.released.clear()
            follower = PendingRequest(held_tile_updates(0, timeout_s=1.0), "follower")
            feed.add(follower)
            reply = follower.reply
            assert isinstance(reply, TileUpdates)
            assert reply.complete
            assert cache.released.wait(servers.WAIT_S)
            assert cache.made_from == -1
