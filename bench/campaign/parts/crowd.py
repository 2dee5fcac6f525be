"""A crowd of clients that want too much, come and go, and invent names."""

import time
from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
import triquad_client
from support import servers
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import Scan

from bench.campaign.server_under_test import (
    expect_honest_service,
    expect_steady_memory,
    server_under_test,
)
from bench.campaign.turn import Turn
from bench.clients.noisy_neighbours import KINDS, neighbour

_ROUND_S = 10
_MOST_AT_ONCE = 4
_SOURCES_A_SECOND = 50
_HONEST_PLACE = 7  # where no ray of the others contradicts what an honest client has seen


def run(turn: Turn) -> None:
    """Let others come and go, round after round; an honest client comes after each."""
    with server_under_test(turn) as server:
        _use_honestly(server.endpoint)  # then all code that the others use is loaded
        before = _outside_the_map(server.endpoint)
        while not turn.over:
            count = turn.random.randint(1, _MOST_AT_ONCE)
            _round(turn, server.endpoint, turn.random.choices(sorted(KINDS), k=count))
            expect_honest_service(server.endpoint, _HONEST_PLACE)
            turn.did("seconds", _ROUND_S)
            expect_steady_memory(turn, before, _outside_the_map(server.endpoint))


def _use_honestly(endpoint: str) -> None:
    """Ask once, and for little, for all that the others ask for."""
    expect_honest_service(endpoint, _HONEST_PLACE)
    with triquad_client.connect(endpoint) as client:
        points = servers.sphere(100)
        client.query_distance(points, unknown_distance=True)
        client.query_segments(points[:50], points[50:], radius_m=0.3)


def _outside_the_map(endpoint: str) -> int:
    """Return the memory of the server without the map, which the crowd's scans enlarge."""
    with triquad_client.connect(endpoint) as client:
        status = client.status()
    return status.memory_bytes - status.map_bytes


def _round(turn: Turn, endpoint: str, kinds: Sequence[str]) -> None:
    """Run neighbours of these kinds in parallel, and publish scans of new sources."""
    with ExitStack() as stack, servers.raw_session(connect=endpoint) as session:
        for kind in kinds:
            stack.enter_context(neighbour(kind, endpoint, servers.MAP))
        ends_s = time.monotonic() + _ROUND_S
        while time.monotonic() < ends_s:
            name = f"invented-{turn.random.getrandbits(60):x}"
            points = np.array([[turn.random.gauss(0, 4) for _ in range(3)]], np.float32)
            scan = Scan(points, np.eye(4), time.time_ns(), name, turn.random.getrandbits(60), 0)
            session.put(keys.scan_key(servers.MAP, name), codec.encode(scan))
            time.sleep(1 / _SOURCES_A_SECOND)
