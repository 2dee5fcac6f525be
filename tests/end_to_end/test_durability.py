"""A real server whose disk fails it: it goes on mapping, says so, and recovers by itself."""

import resource
import shutil
import signal
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support import servers
from triquad_client import RefusedError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files
from triquad_format.mapfile.reader import read_map

POSE = np.eye(4)


@pytest.fixture
def arguments(tmp_path):
    settings = tmp_path / "server.toml"
    settings.write_text(servers.SMALL_TOML)
    return ["--settings", settings, "--store", tmp_path / "store"]


def learn(client, radius_m=servers.RADIUS_M):
    client.publish_scan(servers.sphere(2000, radius_m), POSE)
    client.flush(servers.WAIT_S)
    client.settle(servers.WAIT_S)


def stored_bytes(folder):
    files = (path for path in (folder / "store").rglob("*") if path.is_file())
    return sum(path.stat().st_size for path in files)


@contextmanager
def no_space(pid):
    """Every file that the process writes ends after 10 kB, as on a disk that is full."""
    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (10_000, hard))
    yield
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))


def test_a_full_disk_costs_no_checkpoint_that_was_acknowledged(tmp_path, arguments):
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        learn(client)
        kept = client.checkpoint()
        with no_space(server.process.pid):
            learn(client, 5.0)
            with pytest.raises(RefusedError, match="cannot be written: .*too large"):
                client.checkpoint()
            status = client.status()
            assert "cannot be written" in status.store_error
            assert status.last_checkpoint == kept
            assert status.epoch > kept.epoch
            assert read_map(kept.path).epoch == kept.epoch
            assert [file.epoch for file in checkpoint_files(Path(kept.path).parent)] == [kept.epoch]
            learn(client, 6.0)
            assert client.status().scans_taken == 3
        later = client.checkpoint()
        assert client.status().store_error is None
        assert read_map(later.path).epoch == later.epoch == client.status().epoch
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    assert not list((tmp_path / "store").rglob("*.tmp"))
    assert "Traceback" not in server.log


def test_a_store_that_vanished_does_not_stop_the_server(tmp_path, arguments):
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        learn(client)
        client.checkpoint()
        shutil.rmtree(tmp_path / "store")
        learn(client, 5.0)
        with pytest.raises(RefusedError, match="No such file or directory"):
            client.checkpoint()
        assert "cannot be written" in client.status().store_error
        (tmp_path / "store" / servers.MAP).mkdir(parents=True)
        info = client.checkpoint()
        assert read_map(info.path).epoch == info.epoch
        assert client.status().store_error is None


def test_a_checkpoint_while_it_learns_writes_what_changed(tmp_path, arguments):
    far = np.eye(4)
    far[0, 3] = 100.0
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        for place in range(4):
            pose = np.eye(4)
            pose[0, 3] = 25.0 * place
            client.publish_scan(servers.sphere(), pose)
        client.flush(servers.WAIT_S)
        client.settle(servers.WAIT_S)
        whole = client.checkpoint()
        before_bytes = stored_bytes(tmp_path)
        client.publish_scan(servers.sphere(3000), far)
        client.flush(servers.WAIT_S)
        client.settle(servers.WAIT_S)
        part = client.checkpoint()
        probes = np.concatenate([servers.sphere(200), servers.sphere(200) + far[:3, 3]])
        before = client.query_sdf(probes)
        assert part.bytes > whole.bytes
        assert stored_bytes(tmp_path) - before_bytes < whole.bytes / 2
        server.process.kill()
        server.wait()
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        after = client.query_sdf(probes)
        assert np.array_equal(after.status, before.status)
        assert np.allclose(after.sdf, before.sdf, rtol=0, atol=2e-3)


def test_a_checkpoint_that_was_spoilt_is_written_again_when_asked_for(arguments):
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        learn(client)
        path = Path(client.checkpoint().path)
        path.write_bytes(path.read_bytes()[:1000])
        again = client.checkpoint()
        assert again.epoch == client.status().epoch
        assert read_map(again.path).epoch == again.epoch
        server.process.kill()
        server.wait()
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        assert client.status().regions == 1
