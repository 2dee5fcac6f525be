"""A server within a program: what a script or a notebook does with it, and how it ends."""

import gc
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import triquad_client
import triquad_server
from support import servers
from triquad_client import ClosedError, Status
from triquad_format.errors import FormatError, SettingsError
from triquad_server.errors import ListenError, ServerError, StoreError


@pytest.fixture(autouse=True)
def _compiled() -> None:
    servers.compiled()


def statuses(store: Path, x_m: float = 0.0) -> set[int]:
    """What a stored map says of the sphere that was seen from so far along x."""
    with triquad_client.open_map(store / servers.MAP) as offline:
        return set(offline.query_sdf(servers.sphere(50) + [x_m, 0, 0]).status)


def threads() -> set[threading.Thread]:
    """Those of Python; Zenoh's come and go."""
    return {thread for thread in threading.enumerate() if not thread.name.startswith("Dummy")}


def test_a_map_is_learnt_asked_and_found_again(tmp_path):
    with triquad_server.serve(
        store=tmp_path / "store", settings=servers.SMALL_FILE, map="lab"
    ) as server:
        with server.client() as client:
            assert client.map_name == "lab"
            servers.learn(client)
            before = client.query_distance(servers.sphere(50, 3.0))
        with triquad_client.connect(server.endpoint, "lab") as other:
            assert other.status().map_name == "lab"
    with triquad_server.serve(store=str(tmp_path / "store"), settings=servers.SMALL) as server:
        assert server.client().status().regions == 0  # another map
    with triquad_server.serve(
        store=tmp_path / "store", settings=servers.SMALL_FILE, map="lab"
    ) as server:
        after = server.client().query_distance(servers.sphere(50, 3.0))
    assert np.array_equal(after.found, before.found)
    assert np.median(np.abs(after.distance_m - 1.0)) < 0.2


def test_the_program_keeps_its_signals_and_its_interpreter_its_ways():
    def ways() -> tuple[object, ...]:
        handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        return *handlers, sys.getswitchinterval(), gc.get_freeze_count(), os.nice(0)

    before = ways()
    with triquad_server.serve(settings=servers.SMALL) as server:
        servers.learn(server.client())
        assert ways() == before
    assert ways() == before


def test_no_thread_is_left_and_what_came_of_the_server_is_closed():
    before = threads()
    server = triquad_server.serve(settings=servers.SMALL)
    client = server.client()
    servers.learn(client)
    server.close()
    server.close()
    assert threads() <= before
    with pytest.raises(ClosedError):
        client.status()
    with pytest.raises(ServerError, match="has stopped"):
        server.client()


def test_a_server_that_is_forgotten_stops_and_leaves_its_store(tmp_path):
    server = triquad_server.serve(store=tmp_path, settings=servers.SMALL)
    servers.learn(server.client())
    (thread,) = (t for t in threading.enumerate() if t.name == "triquad-server")
    del server
    gc.collect()
    thread.join(servers.WAIT_S)
    assert not thread.is_alive()
    assert statuses(tmp_path) == {Status.SURFACE}


def test_a_last_checkpoint_that_cannot_be_written_is_an_error(tmp_path):
    server = triquad_server.serve(store=tmp_path, settings=servers.SMALL)
    client = server.client()
    servers.learn(client)
    shutil.rmtree(tmp_path / servers.MAP)
    (tmp_path / servers.MAP).write_text("in the way")
    with pytest.raises(StoreError, match="cannot be written"):
        server.close()
    with pytest.raises(ClosedError):
        client.status()


def test_an_exception_passes_and_what_was_reset_can_be_taken_back(tmp_path):
    def reset_and_fail():
        with triquad_server.serve(store=tmp_path, settings=servers.SMALL) as server:
            servers.learn(server.client())
            raise KeyError(server.client().reset().kept_epoch)

    with pytest.raises(KeyError) as caught:
        reset_and_fail()
    assert statuses(tmp_path) == {Status.UNKNOWN}
    (kept,) = caught.value.args
    triquad_server.serve(store=tmp_path, settings=servers.SMALL, restore=kept).close()
    assert statuses(tmp_path) == {Status.SURFACE}


def test_two_servers_of_one_program_have_maps_of_their_own():
    with (
        triquad_server.serve(settings=servers.SMALL) as one,
        triquad_server.serve(settings=servers.SMALL) as other,
    ):
        servers.learn(one.client())
        assert one.client().status().regions == 1
        assert other.client().status().regions == 0


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"settings": "missing.toml"}, SettingsError, "missing.toml"),
        ({"settings": {"scan": {}}}, SettingsError, "give a Settings record or a TOML file"),
        ({"map": "a/b"}, FormatError, "a/b"),
        ({"listen": "robot:http"}, FormatError, "'http' is not a port"),
        ({"device": "gpu"}, ServerError, "use cpu or cuda"),
        ({"restore": 3}, ServerError, "needs the --store"),
    ],
)
def test_what_cannot_be_is_refused(arguments, error, text):
    with pytest.raises(error, match=text):
        triquad_server.serve(**arguments)


def test_a_restored_map_keeps_its_leaf_and_lengths_that_are_not_set_follow_it(tmp_path, caplog):
    with triquad_server.serve(store=tmp_path, settings=servers.SMALL) as server:
        servers.learn(server.client())
    fine = tmp_path / "fine.toml"
    fine.write_text("[field]\nleaf_m = 0.05\n")
    with triquad_server.serve(store=tmp_path, settings=fine) as server:
        assert "lengths that are not set follow its leaf_m = 0.2, not the 0.05" in caplog.text
        with server.client() as client, client.watch_mesh() as watch:
            watch.catch_up()
            assert watch.tile_side_m == pytest.approx(6.4)
    fine.write_text("[field]\nleaf_m = 0.4\n[mesh]\ncell_m = 1\n")
    with pytest.raises(SettingsError, match="for the restored map: mesh.cell_m = 1"):
        triquad_server.serve(store=tmp_path, settings=fine)


def test_a_port_or_a_store_in_use_is_refused_and_tells_why(tmp_path):
    endpoint = servers.free_endpoint()
    host = endpoint.removeprefix("tcp/")  # and a port: they are enough
    with triquad_server.serve(store=tmp_path, settings=servers.SMALL, listen=host) as server:
        assert server.endpoint == endpoint
        triquad_client.connect(host).close()
        with pytest.raises(ListenError, match="is another server running there"):
            triquad_server.serve(settings=servers.SMALL, listen=endpoint)
        with pytest.raises(StoreError, match="in use by another server: stop that one first"):
            triquad_server.serve(store=tmp_path, settings=servers.SMALL)
        assert server.client().status().map_name == servers.MAP


# Programs of their own, without a guard for the main module, as people write them.
_SERVE = """
    import logging
    import sys
    import triquad_client
    import triquad_server
    from support import servers

    logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
    server = triquad_server.serve(store=sys.argv[1], settings=sys.argv[2])
    client = server.client()
"""
_LEARN_WITHOUT_END = """
    with server:
        for scans in range(1000):
            pose = triquad_client.Pose((10.0 * scans, 0, 0), (0, 0, 0, 1))
            client.publish_scan(servers.sphere(2000), pose)
            assert client.flush(servers.WAIT_S).lost == 0
            print("acknowledged", scans, flush=True)
"""
_FORGET = """
    servers.learn(client)
    watch = client.watch_mesh()
"""


@contextmanager
def program(body: str, *arguments: Path) -> Iterator["subprocess.Popen[str]"]:
    """A program that serves; killed at the end if it still runs."""
    command = [sys.executable, "-c", textwrap.dedent(_SERVE) + textwrap.dedent(body)]
    folders = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [*command, *map(str, arguments)],
        env=folders,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def read_until(process: "subprocess.Popen[str]", text: str) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return
    raise AssertionError(f"the program ended without {text!r}")


def test_ctrl_c_loses_nothing_that_was_acknowledged(tmp_path):
    store = tmp_path / "store"
    with program(_LEARN_WITHOUT_END, store, servers.SMALL_FILE) as process:
        read_until(process, "acknowledged 4")
        process.send_signal(signal.SIGINT)
        read_until(process, "stopping")
        for _ in range(2):
            process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=servers.WAIT_S)
    assert "stopped" in out
    assert errors.splitlines()[-1] == "KeyboardInterrupt"
    later = [int(line.split()[1]) for line in out.splitlines() if "acknowledged" in line]
    for scans in range(max(later, default=4) + 1):
        assert statuses(store, 10.0 * scans) == {Status.SURFACE}


def test_a_program_that_ends_without_closing_ends_well(tmp_path):
    store = tmp_path / "store"
    with program(_FORGET, store, servers.SMALL_FILE) as process:
        out, errors = process.communicate(timeout=servers.WAIT_S)
    assert process.returncode == 0, errors
    assert errors == ""
    assert "stopped" in out
    assert statuses(store) == {Status.SURFACE}
