"""A map that servers share: nobody from beyond takes a region, or passes for one of the servers."""

from pathlib import Path

import numpy as np
from support import servers
from support.attackers.beyond import from_beyond
from triquad_client import connect
from triquad_client.net.shared_connection import SharedConnection
from triquad_format.records.status import Status
from triquad_format.wire import keys
from triquad_format.wire.shares import lease_key, share_key

from bench.clients.server_process import free_endpoint, server_process

MAP = "town"
POINTS = servers.sphere(300).astype(np.float64)


def test_a_stranger_takes_no_region(tmp_path: Path) -> None:
    endpoint = free_endpoint().replace("127.0.0.1", "0.0.0.0")
    here = endpoint.replace("0.0.0.0", "127.0.0.1")
    words = ["--map", MAP, "--share", "--store", tmp_path, "--settings", servers.SMALL_FILE]
    with (
        server_process(words, endpoint) as server,
        connect(here, MAP) as client,
        servers.raw_session(connect=from_beyond(endpoint)) as stranger,
    ):
        servers.learn_all(client)
        forged = [
            share_key(MAP, 2),
            lease_key(MAP, 1, (0, 0, 0), 0),
            *(lease_key(MAP, 2, (x, 0, 0), 0) for x in range(5)),
            keys.alive_key(MAP, f"{MAP}.2"),
        ]
        tokens = [stranger.liveliness().declare_token(key) for key in forged]
        honest = connect(from_beyond(endpoint), MAP)  # what was declared before has been dealt with
        with honest:
            for one in (client, honest):
                assert isinstance(one._connection, SharedConnection)
                found = one.query_sdf(POINTS)
                assert (found.status == Status.SURFACE).mean() > 0.9
                assert one._connection.shares.numbers == {1}
                assert set(one._connection.shares.leases.values()) == {frozenset({1})}
        servers.learn_all(client)
        assert client.status().scans_taken == 6
        del tokens
        server.process.terminate()
        assert server.wait() == 0


def test_a_stranger_s_answers_reach_nobody(tmp_path: Path) -> None:
    endpoint = free_endpoint().replace("127.0.0.1", "0.0.0.0")
    here = endpoint.replace("0.0.0.0", "127.0.0.1")
    words = ["--map", MAP, "--share", "--store", tmp_path, "--settings", servers.SMALL_FILE]
    with (
        server_process(words, endpoint),
        connect(here, MAP) as client,
        servers.raw_session(connect=from_beyond(endpoint)) as stranger,
    ):
        key = keys.operation_key(f"{MAP}.1", keys.STATUS)
        asked = []
        false = stranger.declare_queryable(key, asked.append, complete=True)
        for _ in range(20):
            assert client.status().map_name == MAP
        assert not asked
        false.undeclare()
