"""A disk that is full when the server is asked to stop: whoever started it hears of it."""

import resource
import signal
from pathlib import Path

import numpy as np
import triquad_client
from support import servers
from triquad_format.mapfile.reader import read_map

FULL_BYTES = 10_000


def test_a_last_checkpoint_that_fails_has_an_exit_status_of_its_own(tmp_path: Path) -> None:
    settings = tmp_path / "server.toml"
    settings.write_text(servers.SMALL_TOML)
    arguments = ["--settings", settings, "--store", tmp_path / "store"]
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        servers.learn(client)
        kept = client.checkpoint()
        client.publish_scan(servers.sphere(2000, 5.0), np.eye(4))
        client.flush(servers.WAIT_S)
        _, hard = resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (FULL_BYTES, hard))
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 5
    assert f"what was mapped since epoch {kept.epoch} is lost" in server.log
    assert "Traceback" not in server.log
    assert not list((tmp_path / "store").rglob("*.tmp"))
    assert read_map(kept.path).epoch == kept.epoch
