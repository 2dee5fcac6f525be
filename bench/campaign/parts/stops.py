"""SIGSTOP: processes that are alive but do not run."""

import contextlib
import signal
import time

import numpy as np
import triquad_client
from support import servers
from triquad_client import TriquadError

from bench.campaign.server_under_test import (
    expect,
    expect_honest_service,
    expect_steady_memory,
    learnt_server,
)
from bench.campaign.turn import Turn
from bench.clients.noisy_neighbours import neighbour

_LONGEST_S = 2.0
_MOST_WAIT_S = 10.0  # of an honest client, next to one that is stopped


def run(turn: Turn) -> None:
    """Stop the server, or a client amid its replies, for a while."""
    with learnt_server(turn) as server:
        before = server.resident_bytes
        while not turn.over:
            stopped_s = turn.random.uniform(0, _LONGEST_S)
            if turn.random.random() < 0.5:
                _stop_server(server, stopped_s)
                turn.did("server")
            else:
                _stop_client(turn, server.endpoint, stopped_s)
                turn.did("client")
        expect_steady_memory(turn, before, server.resident_bytes)


def _stop_server(server: servers.ServerProcess, stopped_s: float) -> None:
    """Expect requests to a stopped server to end with errors of triquad; then it serves again."""
    with triquad_client.connect(server.endpoint, timeout_s=0.5) as client:
        server.process.send_signal(signal.SIGSTOP)
        try:
            until = time.monotonic() + stopped_s
            while time.monotonic() < until:
                with contextlib.suppress(TriquadError):
                    client.publish_scan(servers.sphere(500), np.eye(4))
                    client.query_sdf(servers.sphere(10))
        finally:
            server.process.send_signal(signal.SIGCONT)
    expect_honest_service(server.endpoint)


def _stop_client(turn: Turn, endpoint: str, stopped_s: float) -> None:
    """Expect service while a client that asks for much is stopped amid its replies."""
    with neighbour("unread", endpoint, servers.MAP) as greedy:
        time.sleep(turn.random.uniform(0, 0.2))
        greedy.send_signal(signal.SIGSTOP)
        until = time.monotonic() + stopped_s
        with triquad_client.connect(endpoint, timeout_s=2 * _MOST_WAIT_S) as client:
            while time.monotonic() < until:
                asked = time.monotonic()
                client.query_sdf(servers.sphere(100))
                waited_s = time.monotonic() - asked
                turn.measured("longest wait beside a stopped client, s", waited_s)
                expect(waited_s < _MOST_WAIT_S, f"an honest client waited {waited_s:.1f} s")
        greedy.send_signal(signal.SIGCONT)
    expect_honest_service(endpoint)
