"""Clients that want more than their share, leave or read nothing take nothing from the others.

All tests attack one server, in their order: the last one stops it.
"""

import contextlib
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support import servers
from support.servers import until
from triquad_client import Client
from triquad_format.mapfile.checkpoint_folder import checkpoint_files
from triquad_format.wire import keys
from triquad_format.wire.metrics_messages import OperationMetrics
from triquad_tools.demo.probe import Probe

from bench.clients.noisy_neighbours import frozen_neighbours, neighbour

SCANS, PERIOD_S = 40, 0.1
LIMIT_S = 30.0  # a small part of what the requests would take
POINTS = np.random.default_rng(3).uniform(-4, 4, (4000, 3))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("attacked")


@pytest.fixture(scope="module")
def server(store: Path) -> Iterator[servers.ServerProcess]:
    """A server process that has learnt a sphere."""
    with servers.server_process(["--settings", servers.SMALL_FILE, "--store", store]) as server:
        with triquad_client.connect(server.endpoint) as client:
            servers.learn(client)
        yield server


@pytest.fixture
def client(server: servers.ServerProcess) -> Iterator[Client]:
    with triquad_client.connect(server.endpoint, timeout_s=servers.WAIT_S) as client:
        yield client


def asked(client: Client, operation: str) -> OperationMetrics:
    """What became of the requests of an operation so far."""
    return client.metrics().operations[operation]


def publish(client: Client) -> triquad_client.FlushReport:
    """The scans of an honest lidar, at 10 Hz; what became of them."""
    for _ in range(SCANS):
        started = time.monotonic()
        client.publish_scan(servers.sphere(), np.eye(4), source="honest")
        time.sleep(max(0.0, started + PERIOD_S - time.monotonic()))
    return client.flush(servers.WAIT_S)


def test_a_planner_a_viewer_and_a_lidar_do_as_well_beside_noisy_neighbours(server, client) -> None:
    with (
        neighbour("greedy", server.endpoint, servers.MAP),
        frozen_neighbours(server.endpoint, servers.MAP),
        neighbour("flood", server.endpoint, servers.MAP),
        Probe(server.endpoint, servers.MAP, POINTS[:1000], question="distance") as planner,
        client.watch_mesh() as watch,
    ):
        fate = publish(client)
        met = planner.finish()
        refused = asked(client, keys.DISTANCE).refused
        watch.catch_up(servers.WAIT_S)
    assert met.errors == 0, met.last_error
    assert met.queries >= SCANS * PERIOD_S
    assert fate.taken + fate.lost == SCANS
    assert fate.lost <= SCANS // 10, "none, but where the machine is busy with other things"
    assert refused.get("busy", 0) > 0, "the greedy client was never refused anything"
    assert len(watch.mesh().faces)


def test_work_for_a_client_that_has_left_stops(server, client) -> None:
    with neighbour("segments", server.endpoint, servers.MAP):
        until(lambda: asked(client, keys.SEGMENTS).waits.counts.any())
    started = time.monotonic()
    client.query_rays(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), max_range_m=20)
    assert time.monotonic() - started < LIMIT_S
    until(lambda: not asked(client, keys.SEGMENTS).pending, within_s=LIMIT_S)


def test_work_for_a_client_that_waits_no_more_stops(server, client) -> None:
    # Its own time may end a moment after that of the network in between.
    given_up = triquad_client.RequestTimeoutError, triquad_client.NoReplyError
    with triquad_client.connect(server.endpoint, timeout_s=0.2) as impatient:

        def server_gives_up() -> bool:
            with contextlib.suppress(*given_up):
                impatient.query_segments(POINTS[:2000], POINTS[2000:], 0.3)
            return asked(client, keys.SEGMENTS).refused.get("timeout", 0) > 0

        until(server_gives_up)
        until(lambda: not asked(client, keys.SEGMENTS).pending, within_s=LIMIT_S)


def test_sigterm_ends_it_soon_whatever_waits(server, store) -> None:
    with (
        neighbour("segments", server.endpoint, servers.MAP),
        neighbour("greedy", server.endpoint, servers.MAP),
        frozen_neighbours(server.endpoint, servers.MAP),
    ):
        with triquad_client.connect(server.endpoint, timeout_s=servers.WAIT_S) as client:
            until(lambda: asked(client, keys.SEGMENTS).pending > 0)
            taken = servers.learn(client).taken
            epoch = client.status().epoch
            for _ in range(20):
                client.publish_scan(servers.sphere(20_000), np.eye(4))
        started = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
        took_s = time.monotonic() - started
    assert taken
    assert took_s < LIMIT_S, "10 s are promised, of a machine that does nothing else"
    assert "Traceback" not in server.log
    assert checkpoint_files(store / servers.MAP)[0].epoch >= epoch
