"""What goes into a reply to a follower of the mesh, how fast it is sent, and which tiles stay."""

import numpy as np
import pytest
from triquad_map.mesh.tile_lattice import TileBorder
from triquad_server.mesh.followers import TileReply
from triquad_server.mesh.tile_level import CachedTile
from triquad_server.mesh.tile_senders import MAX_CLIENTS, Bandwidth


def tile(x: int, *, revision: int, empty: bool = False) -> CachedTile:
    return CachedTile(
        index=(x, 0, 0),
        version=7,
        revision=revision,
        made=7,
        empty=empty,
        digest=b"",
        border=TileBorder(np.zeros((0, 3), np.int16), np.zeros(0, np.float32)),
    )


def test_the_first_tile_always_fits_and_others_up_to_the_limit() -> None:
    reply = TileReply(complete=True, revision=0)
    assert reply.fits(bytes(100), limit=10)
    reply.add(tile(1, revision=3), bytes(100))
    assert not reply.fits(bytes(1), limit=100)
    assert reply.fits(bytes(1), limit=101)
    assert reply.fits(b"", limit=10), "a tile that is to be removed takes no bytes"


def may_send(bandwidth: Bandwidth, client: str, now_s: float) -> bool:
    return bandwidth.ready_s(client, 1000, now_s) <= now_s


def sent(bandwidth: Bandwidth, rate: float, reply: int, seconds: float) -> float:
    """Bytes a second that a client gets who asks every millisecond."""
    total = 0
    for step in range(int(1000 * seconds)):
        if bandwidth.ready_s("robot", rate, step / 1000) <= step / 1000:
            bandwidth.spend("robot", reply, rate, step / 1000)
            total += reply
    return total / seconds


@pytest.mark.parametrize("reply", [10, 1_000, 5_000])
def test_a_client_gets_what_it_may_have(reply: int) -> None:
    rate = 1000.0
    assert sent(Bandwidth(), rate, reply, 60.0) == pytest.approx(rate, abs=(rate + reply) / 60)


def test_a_pause_is_worth_a_second_at_most() -> None:
    bandwidth = Bandwidth()
    assert may_send(bandwidth, "robot", 0.0)
    bandwidth.spend("robot", 1000, 1000, 3600.0)
    assert not may_send(bandwidth, "robot", 3600.0)
    assert may_send(bandwidth, "robot", 3600.1)


def test_clients_do_not_share() -> None:
    bandwidth = Bandwidth()
    bandwidth.spend("greedy", 10**9, 1000, 0.0)
    assert not may_send(bandwidth, "greedy", 10.0)
    assert may_send(bandwidth, "robot", 10.0)


def test_of_very_many_clients_those_heard_of_longest_ago_are_forgotten() -> None:
    bandwidth = Bandwidth()
    bandwidth.spend("greedy", 10**9, 1000, 0.0)
    for number in range(MAX_CLIENTS - 1):
        assert may_send(bandwidth, f"client-{number}", 1.0)
    assert not may_send(bandwidth, "greedy", 2.0)
    for number in range(MAX_CLIENTS):
        assert may_send(bandwidth, f"other-{number}", 3.0)
    assert may_send(bandwidth, "greedy", 3.0)
