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
from triquad_client import InvalidInputError, TriquadError
from triquad_format.mapfile.reader import read_map
from triquad_map.compiled.kernel import CODE_FOLDER

PROBES = np.concatenate([servers.sphere(50, radius) for radius in (2.0, 3.9, 4.0, 4.1)])
POSE = np.eye(4)


@pytest.fixture
def settings(tmp_path):
    path = tmp_path / "server.toml"
    path.write_text(servers.SMALL_TOML)
    return path


@pytest.fixture
def arguments(tmp_path, settings):
    return ["--settings", settings, "--store", tmp_path / "store"]


def checkpoints(tmp_path):
    return sorted((tmp_path / "store" / servers.MAP).glob("*.triquad"))


def learn(endpoint):
    with triquad_client.connect(endpoint) as client:
        for _ in range(2):
            client.publish_scan(servers.sphere(), POSE)
        assert client.flush(servers.WAIT_S).taken == 2
        client.settle(servers.WAIT_S)
        return client.query_sdf(PROBES, gradient=True)


def ask(endpoint):
    with triquad_client.connect(endpoint) as client:
        return client.query_sdf(PROBES, gradient=True)


def assert_same_map(before, after):
    assert after.epoch >= before.epoch
    assert np.array_equal(after.status, before.status)
    assert np.allclose(after.sdf, before.sdf, rtol=0, atol=2e-3)  # features in half precision


def run(arguments, endpoint=None):
    """A server that ends by itself."""
    with servers.server_process(arguments, endpoint, ready=False) as server:
        server.wait()
    return server


def test_sigterm_keeps_the_map_and_the_next_server_gives_the_same_answers(tmp_path, arguments):
    with servers.server_process(arguments) as server:
        before = learn(server.endpoint)
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    assert f"ready: map 'default' on {server.endpoint}, epoch 1" in server.log
    assert "stopped" in server.log
    newest = checkpoints(tmp_path)[-1]
    assert f"the map is in {newest}, as of epoch {before.epoch}" in server.log
    assert read_map(newest).epoch == before.epoch
    with servers.server_process(arguments) as server:
        assert f"restoring epoch {before.epoch} from {newest}" in server.log
        assert_same_map(before, ask(server.endpoint))


def test_what_is_not_compiled_yet_is_compiled_before_it_serves_and_the_log_says_so(
    tmp_path, arguments
):
    servers.compiled()
    assert CODE_FOLDER is not None
    cache = tmp_path / "cache"
    code = cache / "triquad" / "kernels" / CODE_FOLDER.relative_to(CODE_FOLDER.parents[1])
    shutil.copytree(CODE_FOLDER, code)
    for file in code.rglob("ray_bins.*"):
        file.unlink()
    with servers.server_process(arguments, environment={"XDG_CACHE_HOME": str(cache)}) as server:
        told = [server.log.index(text) for text in ("compiling, step", "once per mach", "ready: ")]
        assert told == sorted(told)
        learn(server.endpoint)
    with servers.server_process(arguments, environment={"XDG_CACHE_HOME": str(cache)}) as server:
        assert "compiling" not in server.log


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="the system tells no mappings")
def test_on_a_cpu_torch_stays_out_of_memory(arguments):
    with servers.server_process(arguments) as server:
        learn(server.endpoint)
        assert "libtorch" not in Path(f"/proc/{server.process.pid}/maps").read_text()


def test_a_restored_map_keeps_its_leaf_and_lengths_that_are_not_set_follow_it(arguments):
    with servers.server_process(arguments) as server:
        learn(server.endpoint)
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    fine = [*arguments, "--set", "field.leaf_m=0.05"]
    with (
        servers.server_process(fine) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        assert "lengths that are not set follow its leaf_m = 0.2, not the 0.05" in server.log
        assert client.tiles().tile_side_m == pytest.approx(6.4)
    unfit = run([*arguments, "--set", "field.leaf_m=0.4", "--set", "mesh.cell_m=1"])
    assert unfit.wait() == 2
    assert "for the restored map: mesh.cell_m = 1" in unfit.log


def test_sigint_and_a_second_signal_stop_it_cleanly(tmp_path, arguments):
    with servers.server_process(arguments) as server:
        before = learn(server.endpoint)
        server.process.send_signal(signal.SIGINT)
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    assert "Traceback" not in server.log
    assert read_map(checkpoints(tmp_path)[-1]).epoch == before.epoch


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_it_has_started_stops_it(arguments, number):
    with servers.server_process(arguments, ready=False) as server:
        server.wait_for("preparing compiled code")
        server.process.send_signal(number)
        assert server.wait() == 0
    assert "stopped" in server.log
    assert "ready" not in server.log
    assert "Traceback" not in server.log


def test_sigterm_amid_a_stream_of_scans(tmp_path, arguments):
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        for _ in range(40):
            client.publish_scan(servers.sphere(20_000), POSE)
        client.flush(servers.WAIT_S, pending=20)  # fewer than may wait: some are taken
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    assert "Traceback" not in server.log
    assert len(read_map(checkpoints(tmp_path)[-1]).regions) == 1


def test_after_sigkill_the_last_checkpoint_counts(tmp_path, arguments):
    with servers.server_process(arguments) as server:
        before = learn(server.endpoint)
        with triquad_client.connect(server.endpoint) as client:
            client.checkpoint()
            client.publish_scan(servers.sphere(2000, 6.0), POSE)
            client.flush(servers.WAIT_S)
        server.process.kill()
        server.wait()
    with servers.server_process(arguments) as server:
        assert_same_map(before, ask(server.endpoint))


def test_where_memory_runs_out_it_ends_and_the_last_checkpoint_counts(tmp_path, arguments):
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
    with servers.server_process(arguments) as server:
        assert_same_map(before, ask(server.endpoint))


def test_a_damaged_checkpoint_falls_back_to_the_one_before_and_says_so(tmp_path, arguments):
    with servers.server_process(arguments) as server:
        with triquad_client.connect(server.endpoint) as client:
            before = learn(server.endpoint)
            good = Path(client.checkpoint().path)
            client.publish_scan(servers.sphere(2000, 6.0), POSE)
            client.flush(servers.WAIT_S)
            client.settle(servers.WAIT_S)
            bad = Path(client.checkpoint().path)
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    payload = bytearray(bad.read_bytes())
    payload[len(payload) // 2] ^= 0xFF
    bad.write_bytes(payload)
    with servers.server_process(arguments) as server:
        assert f"checkpoint {bad} is damaged" in server.log
        assert f"the older checkpoint {good} is used instead" in server.log
        assert_same_map(before, ask(server.endpoint))


def test_all_checkpoints_damaged_is_no_reason_to_start_empty(tmp_path, arguments):
    folder = tmp_path / "store" / servers.MAP
    folder.mkdir(parents=True)
    (folder / "epoch-000000007.triquad").write_bytes(b"not a map")
    server = run(arguments)
    assert server.process.returncode == 4
    assert "all 1 checkpoints" in server.log


def test_without_a_store_it_says_that_the_map_is_not_kept(settings):
    with servers.server_process(["--settings", settings, "--map", "lab"]) as server:
        assert "the map is not kept" in server.log
        with triquad_client.connect(server.endpoint, "lab") as client:
            assert client.maps() == ["lab"]
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0


def test_nobody_to_connect_to_is_exit_code_3():
    nobody = servers.free_endpoint()
    server = run(["--connect", nobody])
    assert server.process.returncode == 3
    assert f"cannot connect to {nobody}" in server.log
    assert "Start a router there first." in server.log
    assert "ready" not in server.log


def test_a_port_in_use_is_exit_code_3():
    endpoint = servers.free_endpoint()
    with servers.raw_session("router", listen=endpoint):
        server = run([], endpoint)
    assert server.process.returncode == 3
    assert "is another server running there?" in server.log
    assert "Traceback" not in server.log


def test_a_store_that_cannot_be_written_is_exit_code_4(tmp_path):
    (tmp_path / "file").write_text("")
    server = run(["--store", tmp_path / "file" / "store"])
    assert server.process.returncode == 4
    assert "cannot be written" in server.log


def test_a_last_checkpoint_that_is_not_written_is_exit_code_5(tmp_path, arguments):
    with servers.server_process(arguments) as server:
        with triquad_client.connect(server.endpoint) as client:
            servers.learn(client)
        shutil.rmtree(tmp_path / "store" / servers.MAP)
        (tmp_path / "store" / servers.MAP).write_text("in the way")
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 5
    assert "cannot be written" in server.log
    assert "Traceback" not in server.log


def test_a_store_in_use_is_exit_code_4(tmp_path, arguments):
    with servers.server_process(arguments):
        server = run(arguments)
    assert server.process.returncode == 4
    assert "in use by another server" in server.log


@pytest.mark.parametrize(
    ("toml", "text"),
    [
        (
            "[service]\nscan_que = 3\n",
            "unknown setting service.scan_que: did you mean service.scan_queue?",
        ),
        ("[service]\nscan_queue = -3\n", "scan_queue = -3 is out of range"),
        ("[service\n", "settings file"),
    ],
)
def test_settings_that_are_wrong_are_exit_code_2(settings, toml, text):
    settings.write_text(toml)
    server = run(["--settings", settings])
    assert server.process.returncode == 2
    assert text in server.log


@pytest.mark.parametrize(
    "arguments",
    [
        ["--map", "a/b"],
        ["--mode", "boat"],
        ["--config", "missing.json5"],
        ["--listen", "robot:http"],
        ["--connect", "7447"],
        ["--no-such-option"],
    ],
)
def test_wrong_usage_is_exit_code_2(arguments):
    server = run(arguments)
    assert server.process.returncode == 2
    assert "Traceback" not in server.log


def test_a_host_and_a_port_are_enough(settings):
    host = servers.free_endpoint().removeprefix("tcp/")
    with servers.server_process(["--settings", settings], endpoint=host):
        with triquad_client.connect(host) as client:
            assert client.status().map_name == servers.MAP
        with pytest.raises(InvalidInputError, match="'http' is not a port"):
            triquad_client.connect("robot:http")


def test_a_zenoh_configuration_file_is_used(tmp_path, settings):
    file = tmp_path / "zenoh.json5"
    endpoint = servers.free_endpoint()
    file.write_text(f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }} }}')
    with (
        servers.server_process(["--settings", settings, "--config", file]) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        assert client.status().map_name == servers.MAP


A_THREAD_ENDS = """
from triquad_server.intake.scan import ScanIntake

keep, kept = ScanIntake._keep, []

def keep_two(intake, sample):
    if len(kept) == 2:
        raise RuntimeError("a defect")
    kept.append(sample)
    keep(intake, sample)

ScanIntake._keep = keep_two
"""


def test_a_thread_that_ends_by_a_defect_stops_the_server_after_a_last_checkpoint(
    tmp_path, arguments
):
    (tmp_path / "sitecustomize.py").write_text(A_THREAD_ENDS)
    with servers.server_process(arguments, environment={"PYTHONPATH": str(tmp_path)}) as server:
        before = learn(server.endpoint)
        with triquad_client.connect(server.endpoint) as client:
            client.publish_scan(servers.sphere(), POSE)
        assert server.wait() == 1
    assert "RuntimeError: a defect" in server.log
    assert "stopping, by an internal error" in server.log
    with servers.server_process(arguments) as server:
        assert_same_map(before, ask(server.endpoint))
