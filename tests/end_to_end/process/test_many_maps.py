"""Several maps in one server: each learns and answers for itself, and some come and go."""

import json
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from support import servers
from support.poses import shifted
from triquad_client import Client, RefusedError, UnknownMapError, connect
from triquad_format.errors import InvalidInputError
from triquad_format.records.status import Status

from bench.clients.server_process import ServerProcess, free_port, server_process

RESTORE = ("--store", "x", "--restore", "1")
POINTS = servers.sphere(300).astype(np.float64)


@contextmanager
def serving(*arguments: str | Path, maps: tuple[str, ...] = ("a", "b")) -> Iterator[ServerProcess]:
    named = [word for name in maps for word in ("--map", name)]
    with server_process([*named, "--settings", servers.SMALL_FILE, *arguments]) as server:
        yield server


@contextmanager
def clients(server: ServerProcess, *maps: str) -> Iterator[list[Client]]:
    with ExitStack() as stack:
        yield [stack.enter_context(connect(server.endpoint, name)) for name in maps]


def shows_sphere(client: Client, at_m: float = 0.0) -> bool:
    """Whether the map has the surface of a sphere that was scanned from its centre."""
    found = client.query_sdf(POINTS + [at_m, 0.0, 0.0])
    return bool((found.status == Status.SURFACE).mean() > 0.9)


def page(port: int, name: str) -> str:
    url = f"http://127.0.0.1:{port}/{name}"
    with urllib.request.urlopen(url, timeout=servers.WAIT_S) as reply:
        text: str = reply.read().decode()
        return text


def stopped(server: ServerProcess) -> str:
    server.process.terminate()
    assert server.wait() == 0, server.log
    return server.log


def test_each_map_learns_what_is_published_for_it_alone(tmp_path: Path) -> None:
    with serving("--store", tmp_path) as server, clients(server, "a", "b") as (a, b):
        servers.learn_all(a)
        servers.learn_all(b, pose=shifted(50.0))
        assert (a.maps(), b.maps()) == (["a", "b"], ["a", "b"])
        assert (shows_sphere(a), shows_sphere(a, 50.0)) == (True, False)
        assert (shows_sphere(b), shows_sphere(b, 50.0)) == (False, True)
        status = a.status()
        assert status.server != b.status().server
        assert status.memory_parts["other maps"] >= b.status().map_bytes
        a.reset()
        assert (shows_sphere(a), shows_sphere(b, 50.0)) == (False, True)
        stopped(server)
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


def test_maps_come_and_go_and_a_restart_knows(tmp_path: Path) -> None:
    with serving("--store", tmp_path) as server, clients(server, "a", "b") as (a, b):
        servers.learn_all(b)
        a.create_map("c")
        with connect(server.endpoint, "c") as c:
            servers.learn_all(c, pose=shifted(50.0))
            kept = a.drop_map("b")
            assert kept is not None
            assert a.maps() == ["a", "c"]
            with pytest.raises(UnknownMapError, match="a, c"):
                b.status()
            assert shows_sphere(c, 50.0)
        stopped(server)
    with serving("--store", tmp_path) as server, clients(server, "a", "b", "c") as (a, b, c):
        assert [one.status().scans_taken for one in (a, b, c)] == [0, 0, 3]
        assert shows_sphere(c, 50.0)
        assert a.drop_map("b") is not None
        Path(kept).rename(tmp_path / "b")
        a.create_map("b")
        with connect(server.endpoint, "b") as again:
            assert shows_sphere(again)
        a.drop_map("c")
        stopped(server)
    with serving("--store", tmp_path) as server, clients(server, "a") as (a,):
        assert a.maps() == ["a", "b"]


def test_a_server_opens_what_was_created_by_it_and_not_by_others(tmp_path: Path) -> None:
    with serving("--store", tmp_path, maps=("a",)) as server, clients(server, "a") as (a,):
        a.create_map("of-a")
        stopped(server)
    with serving("--store", tmp_path, maps=("b",)) as server, clients(server, "b") as (b,):
        assert b.maps() == ["b"]


def test_a_created_map_that_is_damaged_does_not_keep_the_others_from_it(tmp_path: Path) -> None:
    with serving("--store", tmp_path, maps=("a",)) as server, clients(server, "a") as (a,):
        servers.learn_all(a)
        for name in ("bad", "good"):
            a.create_map(name)
            with connect(server.endpoint, name) as client:
                servers.learn_all(client)
        stopped(server)
    for file in (tmp_path / "bad").glob("*.checkpoint"):
        file.write_bytes(b"rot")
    with serving("--store", tmp_path, maps=("a",)) as server, clients(server, "a") as (a,):
        assert a.maps() == ["a", "good"]
        assert "map 'bad', which a client has created, is not opened" in server.log
        with pytest.raises(RefusedError, match="store.*damaged"):
            a.create_map("bad")


def test_what_a_dropped_map_took_is_free_again() -> None:
    with serving(maps=("a", "b")) as server, clients(server, "a", "b") as (a, b):
        b.publish_scan(servers.sphere(60_000, 20.0), shifted(0.0))
        b.flush(servers.WAIT_S)
        took = b.status().map_bytes
        assert took > 10_000_000
        before = server.resident_bytes
        a.drop_map("b")
        servers.until(lambda: server.resident_bytes < before - took / 2)


def test_figures_and_health_are_told_of_each_map() -> None:
    port = free_port()
    with serving("--metrics-port", str(port)) as server, clients(server, "a", "b") as (a, _):
        servers.learn_all(a)
        page = (
            urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60).read().decode()
        )
        taken = {
            sample.labels["map"]: sample.value
            for family in text_string_to_metric_families(page)
            for sample in family.samples
            if sample.name == "triquad_epoch"
        }
        assert taken["a"] > taken["b"]
        text = urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=60).read()
        report = json.loads(text)
        assert report["problem"] is None
        assert {name: one["scans_taken"] for name, one in report["maps"].items()} == {
            "a": 3,
            "b": 0,
        }


def test_without_a_store_maps_last_as_long_as_the_server() -> None:
    with serving(maps=("a",)) as server, clients(server, "a") as (a,):
        a.create_map("b")
        with connect(server.endpoint, "b") as b:
            servers.learn_all(b)
            b.drop_map("a")
            assert b.maps() == ["b"]
            assert shows_sphere(b)
            b.create_map("a")
        assert a.drop_map("b") is None


def test_what_cannot_be_opened_or_dropped_is_refused_and_nothing_changes(tmp_path: Path) -> None:
    with serving("--store", tmp_path) as server, clients(server, "a") as (a,):
        with pytest.raises(RefusedError, match="map_exists.*'b' already"):
            a.create_map("b")
        with pytest.raises(RefusedError, match="no_map.*no map 'c', but a, b"):
            a.drop_map("c")
        with pytest.raises(RefusedError, match="bad_request.*another of its maps"):
            a.drop_map("a")
        for name in ("", "c/d", "../c", "*", ".c"):
            with pytest.raises(InvalidInputError, match="name .* is not allowed"):
                a.create_map(name)
        with (
            serving("--store", tmp_path, maps=("c",)),
            pytest.raises(RefusedError, match="store.*in use by another server"),
        ):
            a.create_map("c")
        with (
            serving("--connect", server.endpoint, maps=("d",)),
            pytest.raises(RefusedError, match="map_exists.*'d' already"),
        ):
            a.create_map("d")
        (tmp_path / "e").write_text("no folder")
        with pytest.raises(RefusedError, match="store"):
            a.create_map("e")
        assert a.maps() == ["a", "b"]
        a.create_map("c")


def test_there_are_as_many_maps_as_memory_has_room_for() -> None:
    little = ("--set", "memory.max_bytes=750000000")

    def fill(client: Client) -> None:
        for number in range(5):
            client.create_map(f"more-{number}")

    with serving(*little, maps=("a",)) as server, clients(server, "a") as (a,):
        with pytest.raises(RefusedError, match="busy.*maps give the server at least"):
            fill(a)
        servers.learn_all(a)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--map", "a", "--map", "a"], "--map a is given twice"),
        (["--map", "a", "--map", "b", *RESTORE], "--restore is for one map"),
        (["--map", "a", "--map", "b/c"], "'b/c' is not allowed"),
    ],
)
def test_maps_that_cannot_be_named_are_refused(arguments: list[str], told: str) -> None:
    with server_process(arguments, ready=False) as server:
        assert server.wait() == 2
        assert told in server.log
