"""A server stops when it is asked to, whatever waits, and keeps what it has learnt."""

import signal
import time

import triquad_client
from support import servers
from support.attackers.attacked import attacked_server, operation
from triquad_format.mapfile.checkpoint_folder import checkpoint_files
from triquad_format.wire import keys

from bench.clients.noisy_neighbours import frozen_neighbours, neighbour

LIMIT_S = 10.0


def test_sigterm_ends_within_ten_seconds_whatever_waits(tmp_path):
    with (
        attacked_server(tmp_path) as server,
        neighbour("segments", server.endpoint, servers.MAP),
        neighbour("greedy", server.endpoint, servers.MAP),
        frozen_neighbours(server.endpoint, servers.MAP),
    ):
        with triquad_client.connect(server.endpoint, timeout_s=servers.WAIT_S) as client:
            while not operation(client, keys.SEGMENTS).waits.counts.any():
                time.sleep(0.02)
            taken = servers.learn(client).taken
            epoch = client.status().epoch
        started = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
        took_s = time.monotonic() - started
    print(f"\nended {took_s:.1f} s after SIGTERM")
    assert taken
    assert took_s < LIMIT_S
    kept = checkpoint_files(tmp_path / "store" / servers.MAP)
    assert kept[0].epoch >= epoch
