"""What a client asked for is not worked at once it has left or does not wait any more."""

import contextlib
import time

import numpy as np
import pytest
import triquad_client
from support import servers
from support.attackers.attacked import attacked_server, operation, points
from triquad_format.wire import keys

from bench.clients.noisy_neighbours import neighbour

LIMIT_S = 10.0  # a hundredth of what the requests would take


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with attacked_server(tmp_path_factory.mktemp("departed")) as server:
        yield server


@pytest.fixture(scope="module")
def client(server):
    with triquad_client.connect(server.endpoint, timeout_s=servers.WAIT_S) as client:
        yield client


def until_none_is_pending(client, name):
    """How long it takes until no request of an operation is pending, seconds."""
    started = time.monotonic()
    while operation(client, name).pending:
        assert time.monotonic() < started + LIMIT_S, "the server works for nobody"
        time.sleep(0.02)
    return time.monotonic() - started


def test_work_for_a_client_that_has_left_stops(server, client):
    with neighbour("segments", server.endpoint, servers.MAP):
        while not operation(client, keys.SEGMENTS).waits.counts.any():
            time.sleep(0.02)
    started = time.monotonic()
    client.query_rays(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), max_range_m=20)
    ray_s = time.monotonic() - started
    stopped_s = until_none_is_pending(client, keys.SEGMENTS)
    print(f"\na ray of somebody else after {ray_s:.2f} s; all work stopped after {stopped_s:.2f} s")
    assert ray_s < LIMIT_S


def test_work_for_a_client_that_waits_no_more_stops(server, client):
    many = points(4_000)
    # Its own time may end a moment after that of the network in between.
    given_up = triquad_client.RequestTimeoutError, triquad_client.NoReplyError
    ends_s = time.monotonic() + servers.WAIT_S
    with triquad_client.connect(server.endpoint, timeout_s=0.2) as impatient:
        while not operation(client, keys.SEGMENTS).refused.get("timeout", 0):
            assert time.monotonic() < ends_s, "no request was given up by the server"
            with contextlib.suppress(*given_up):
                impatient.query_segments(many[:2000], many[2000:], 0.3)
        until_none_is_pending(client, keys.SEGMENTS)
