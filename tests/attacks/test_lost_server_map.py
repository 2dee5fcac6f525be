"""A server that comes back without its map does not take the copies of its clients with it."""

import time
from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support import servers
from triquad_client import Client, ConnectError, EmptierMapError, Status

BOX = ((-10, -10, -10), (10, 10, 10))
POINTS = np.random.default_rng(0).uniform(-5, 5, (500, 3))


def learnt_and_copied(client: Client, path: Path) -> triquad_client.SyncedMap:
    servers.learn(client)
    client.settle(servers.WAIT_S)
    return client.sync(BOX, path)


def knows(copy: triquad_client.SyncedMap) -> bool:
    return bool((copy.query_sdf(POINTS).status != Status.UNKNOWN).any())


def refresh_once_linked(local: triquad_client.SyncedMap) -> None:
    """The link is set up again some time after it was lost."""
    deadline_s = time.monotonic() + servers.WAIT_S
    while True:
        try:
            local.refresh()
            return
        except ConnectError:
            assert time.monotonic() < deadline_s
            time.sleep(0.1)


def test_a_copy_outlives_a_server_that_starts_again_empty(tmp_path: Path) -> None:
    path = tmp_path / "copy.triquad"
    settings = tmp_path / "settings.toml"
    settings.write_text(servers.SMALL_TOML)
    arguments = ["--settings", settings]
    with servers.server_process(arguments) as server:
        client = triquad_client.connect(server.endpoint)
        local = learnt_and_copied(client, path)
        before, data = local.query_sdf(POINTS), path.read_bytes()
        server.process.kill()
        server.wait()
    with client, servers.server_process(arguments, endpoint=server.endpoint):
        with pytest.raises(EmptierMapError, match="The copy stays as it is.*accept_emptier=True"):
            refresh_once_linked(local)
        assert np.array_equal(local.query_sdf(POINTS).status, before.status)
        # A program that was started again, too, has the file alone.
        with pytest.raises(EmptierMapError):
            client.sync(BOX, path)
        assert path.read_bytes() == data
        taken = client.sync(BOX, path, accept_emptier=True)
        assert not knows(taken)
        servers.learn(client, scans=1)
        taken.refresh()
        assert knows(taken)


def test_what_a_server_was_told_to_forget_is_forgotten(tmp_path: Path) -> None:
    with servers.service_and_client() as client:
        local = learnt_and_copied(client, tmp_path / "copy.triquad")
        client.reset()
        local.refresh()
        assert not knows(local)
