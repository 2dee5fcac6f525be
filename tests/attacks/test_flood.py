"""Clients that ask for too much, send too much or read nothing take nothing from the others."""

import time

import numpy as np
import pytest
import triquad_client
from support import servers
from support.attackers.attacked import attacked_server, operation, points
from triquad_format.wire import keys
from triquad_tools.demo.probe import Probe

from bench.clients.noisy_neighbours import frozen_neighbours, neighbour

SCANS = 40
PERIOD_S = 0.1


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with attacked_server(tmp_path_factory.mktemp("flood")) as server:
        yield server


def publish(client):
    """The scans of an honest lidar, at 10 Hz; what became of them."""
    for _ in range(SCANS):
        started = time.monotonic()
        client.publish_scan(servers.sphere(), np.eye(4), source="honest")
        time.sleep(max(0.0, started + PERIOD_S - time.monotonic()))
    return client.flush(servers.WAIT_S)


def told(name, met, fate):
    print(
        f"\n{name}: p50 {met.latency_p50_ms:.1f} ms, p99 {met.latency_p99_ms:.1f} ms of "
        f"{met.queries} queries, {met.errors} errors; {fate.lost} of {SCANS} scans lost"
    )


def test_a_planner_and_a_lidar_do_as_well_beside_noisy_neighbours(server):
    with (
        triquad_client.connect(server.endpoint) as lidar,
        neighbour("greedy", server.endpoint, servers.MAP),
        frozen_neighbours(server.endpoint, servers.MAP),
        neighbour("flood", server.endpoint, servers.MAP),
        Probe(server.endpoint, servers.MAP, points(), question="distance") as planner,
    ):
        fate = publish(lidar)
        met = planner.finish()
        refused = operation(lidar, keys.DISTANCE).refused
    told("beside a greedy, a frozen and a flooding client", met, fate)
    assert met.errors == 0, met.last_error
    assert met.queries >= SCANS * PERIOD_S
    assert (fate.taken, fate.lost) == (SCANS, 0)
    assert refused.get("busy", 0) > 0, "the greedy client was never refused anything"
