"""``triquad-server`` as a process: signals, exit codes, restarts."""

import contextlib
import resource
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support import servers
from triquad_client import TriquadError
from triquad_format.mapfile.reader import read_map
from triquad_map.compiled.kernel import CODE_FOLDER

PROBES = np.concatenate([servers.sphere(50, radius) for radius in (2.0, 3.9, 4.0, 4.1)])


@pytest.fixture
def store(tmp_path):
    return tmp_path / "store"


def newest_checkpoint(store):
    return max((store / servers.MAP).glob("*.checkpoint"))


def learn(endpoint):
    with triquad_client.connect(endpoint) as client:
        assert servers.learn_all(client).scans_taken == 3
        return client.query_sdf(PROBES, gradient=True)


def assert_kept(store, before):
    """A server that goes on from a store answers as one did before."""
    with servers.service_and_client(store=store) as client:
        servers.assert_same_map(before, client.query_sdf(PROBES, gradient=True))


def test_sigterm_keeps_the_map_and_the_next_server_gives_the_same_answers(store, arguments):
    with servers.server_process(arguments) as server:
        before = learn(server.endpoint)
        if (maps := Path(f"/proc/{server.process.pid}/maps")).exists():
            assert "libtorch" not in maps.read_text()  # on a CPU it stays out of memory
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    assert f"ready: map 'default' on {server.endpoint}, epoch 1" in server.log
    assert "stopped" in server.log
    newest = newest_checkpoint(store)
    assert f"the map is in {newest}, as of epoch {before.epoch}" in server.log
    assert read_map(newest).epoch == before.epoch
    with servers.server_process(arguments) as server:
        assert f"restoring epoch {before.epoch} from {newest}" in server.log
        with triquad_client.connect(server.endpoint) as client:
            servers.assert_same_map(before, client.query_sdf(PROBES, gradient=True))
            epoch = client.status().epoch
        server.process.send_signal(signal.SIGINT)
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    assert "Traceback" not in server.log
    assert read_map(newest_checkpoint(store)).epoch == epoch


@pytest.mark.long
@pytest.mark.parametrize("missing", ["ray_bins.*", "*"])
def test_what_is_not_compiled_yet_is_compiled_before_it_serves_and_the_log_says_so(
    tmp_path, arguments, missing
):
    servers.compiled()
    assert CODE_FOLDER is not None
    cache = tmp_path / "cache"
    code = cache / "triquad" / "kernels" / CODE_FOLDER.relative_to(CODE_FOLDER.parents[1])
    shutil.copytree(CODE_FOLDER, code)
    for file in filter(Path.is_file, list(code.rglob(missing))):
        file.unlink()
    with servers.server_process(arguments, environment={"XDG_CACHE_HOME": str(cache)}) as server:
        told = [server.log.index(text) for text in ("compiling, step", "once per mach", "ready: ")]
        assert told == sorted(told)
        learn(server.endpoint)
    with servers.server_process(arguments, environment={"XDG_CACHE_HOME": str(cache)}) as server:
        assert "compiling" not in server.log


def test_where_memory_runs_out_it_ends_and_the_last_checkpoint_counts(store, arguments):
    with servers.server_process(arguments) as server:
        before = learn(server.endpoint)
        pid = server.process.pid
        with triquad_client.connect(server.endpoint, timeout_s=5.0) as client:
            client.checkpoint()
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
            most = pages * resource.getpagesize() + 8 * 2**20
            resource.prlimit(pid, resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
            pose = np.eye(4)
            with contextlib.suppress(TriquadError):
                while server.process.poll() is None:
                    pose[0, 3] += 20.0
                    client.publish_scan(servers.sphere(20_000, 30.0), pose)
                    client.flush(5.0)
        assert server.wait() != 0
    assert "Traceback" not in server.log
    assert "internal error" not in server.log
    assert_kept(store, before)


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--no-such-option"], 2, "usage: triquad-server"),
        (["--map", "a/b"], 2, "a/b"),
        (["--config", "missing.json5"], 2, "Zenoh configuration missing.json5"),
        (["--log-format", "xml"], 2, "is no format: use text or json"),
        (["--set", "service.scan_que=3"], 2, "did you mean service.scan_queue?"),
        (["--connect", "tcp/127.0.0.1:1"], 3, "Start a router there first."),
        (["--store", "/dev/null/store"], 4, "cannot be written"),
        (["--store", "STORE"], 4, "all 1 checkpoints"),
        (["--store", "STORE", "--restore", "3"], 4, "holds no checkpoint of epoch 3; there are: "),
    ],
)
def test_each_cause_for_which_it_cannot_start_has_its_exit_code(store, arguments, code, text):
    folder = store / servers.MAP
    folder.mkdir(parents=True)
    damaged = folder / "epoch-000000007.triquad"
    damaged.write_bytes(b"not a map")
    arguments = [word.replace("STORE", str(store)) for word in arguments]
    with servers.server_process(arguments, ready=False) as server:
        assert server.wait() == code
    assert text in server.log
    assert "ready" not in server.log
    assert damaged.exists()

    assert "Traceback" not in server.log


A_THREAD_ENDS = """
from pathlib import Path
from triquad_server.server_status import Heartbeat

def fail_later(heartbeat, status):
    if Path(__file__).with_name("fail").exists():
        raise RuntimeError("a defect")

Heartbeat._log_progress = fail_later
"""


def test_a_thread_that_ends_by_a_defect_stops_the_server_after_a_last_checkpoint(
    tmp_path, store, arguments
):
    (tmp_path / "sitecustomize.py").write_text(A_THREAD_ENDS)
    with servers.server_process(arguments, environment={"PYTHONPATH": str(tmp_path)}) as server:
        before = learn(server.endpoint)
        (tmp_path / "fail").touch()
        assert server.wait() == 1
    assert "RuntimeError: a defect" in server.log
    assert "stopping, by an internal error" in server.log
    assert_kept(store, before)
