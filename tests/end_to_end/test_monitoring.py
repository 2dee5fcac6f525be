"""The port for Prometheus and supervisors, of a real server over real HTTP."""

import http.client
import json
import math
import re
import resource
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pytest
import triquad_client
import triquad_server
from prometheus_client.parser import text_string_to_metric_families
from support import servers
from triquad_client import RefusedError
from triquad_format.mapfile.reader import read_map
from triquad_format.printable import printable
from triquad_server.errors import ListenError
from triquad_server.monitoring.prometheus import FAMILIES
from triquad_server.settings import MetricsSettings

from bench.clients.server_process import free_port

PAGE = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text(encoding="utf-8")


class Answer(NamedTuple):
    code: int
    content_type: str
    body: str


def get(port: int, path: str) -> Answer:
    try:
        url = f"http://127.0.0.1:{port}{path}"
        with urllib.request.urlopen(url, timeout=servers.WAIT_S) as reply:
            return Answer(reply.status, reply.headers["Content-Type"], reply.read().decode())
    except urllib.error.HTTPError as error:
        with error:
            return Answer(error.code, error.headers["Content-Type"], error.read().decode())


def health(port: int) -> tuple[int, dict[str, object]]:
    answer = get(port, "/healthz")
    assert answer.content_type == "application/json"
    return answer.code, json.loads(answer.body)


def samples(
    port: int, map_name: str = servers.MAP
) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """All values of a map, by name and sorted labels."""
    families = text_string_to_metric_families(get(port, "/metrics").body)
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in families
        for sample in family.samples
        if sample.labels.pop("map") == map_name
    }


@pytest.fixture(scope="module")
def port():
    """Of a server that was asked something of everything."""
    port = free_port()
    settings = servers.SMALL.model_copy(update={"metrics": MetricsSettings(port=port)})
    servers.compiled()
    with triquad_server.serve(settings=settings) as server, server.client() as client:
        servers.learn_all(client, 2)
        client.mesh()
        for _ in range(5):
            client.query_sdf(servers.sphere(100))
        with pytest.raises(RefusedError):
            client.query_distance([[0, 0, 0]], at_epoch=10**6)
        client.metrics()
        yield port


def test_prometheus_is_told_what_clients_are_told(port):
    found = samples(port)
    sdf = (("operation", "query/sdf"),)
    assert found["triquad_request_duration_seconds_count", sdf] == 5
    buckets = {
        float(dict(labels)["le"]): count
        for (name, labels), count in found.items()
        if name == "triquad_request_duration_seconds_bucket" and sdf[0] in labels
    }
    assert [count for _, count in sorted(buckets.items())] == sorted(buckets.values())
    assert buckets[math.inf] == 5
    gone = (("code", "epoch_gone"), ("operation", "query/distance"))
    assert found["triquad_requests_refused_total", gone] == 1
    taken = (("outcome", "taken"), ("source", "default"))
    assert found["triquad_source_scans_total", taken] == 2
    assert found["triquad_settled", ()] == 1
    assert found["triquad_healthy", ()] == 1
    assert found["triquad_samples_trained_total", ()] > 0
    assert found["triquad_mapper_seconds_total", (("activity", "training"),)] > 0
    assert found["triquad_sessions", (("kind", "client"),)] == 1
    assert not any("query/align" in dict(labels).values() for _, labels in found)
    assert get(port, "/metrics").content_type.startswith("text/plain; version=0.0.4")


def test_the_page_lists_what_is_exposed(port):
    rows = re.findall(r"^\| `(triquad_\w+)` \| (\w+) \| (.*?) \| (.*) \|$", PAGE, re.M)
    listed = {(name, kind, labels, text) for name, kind, labels, text in rows}
    exposed = set()
    families = {
        family.name: family for family in text_string_to_metric_families(get(port, "/metrics").body)
    }
    for family in FAMILIES:
        found = families[family.name.removesuffix("_total")]
        for sample in found.samples:
            assert set(sample.labels) - {"le"} == set(family.labels), family.name
        labels = ", ".join(f"`{label}`" for label in family.labels)
        exposed.add((family.name, found.type, labels, found.documentation))
    assert listed == exposed
    assert len(rows) == len(FAMILIES) == len(families)


def test_nothing_else_is_answered_and_nothing_breaks_it(port):
    assert get(port, "/").code == 404
    assert "/healthz" in get(port, "/map").body
    assert get(port, "/metrics?name=x").code == 200
    assert get(port, "/%0d%0aX:%20y" + "a" * 5000).code == 404
    hostile = [b"\xff" * 100_000, b"GET /metrics HTTP/9.9\r\n\r\n", b"\r\n" * 10, b"GET " * 10]
    for words in hostile:
        with socket.create_connection(("127.0.0.1", port)) as connection, suppress(OSError):
            connection.sendall(words)
            connection.shutdown(socket.SHUT_WR)
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"POST /healthz HTTP/1.0\r\n\r\n")
        assert b"501" in connection.recv(1000)
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=servers.WAIT_S)) as probe:
        probe.request("HEAD", "/healthz")  # the head alone
        reply = probe.getresponse()
        assert (reply.status, reply.read()) == (200, b"")
    assert health(port)[0] == 200


def test_connections_that_stall_or_trickle_take_some_threads_for_some_seconds(port, monkeypatch):
    monkeypatch.setattr("triquad_server.monitoring.http_server._TIMEOUT_S", 1.0)
    with ExitStack() as stack:
        opened = [
            stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(20)
        ]
        opened[-1].settimeout(servers.WAIT_S)
        assert opened[-1].recv(1) == b""  # closed at once, while the first ones are waited for
        for connection in opened:
            connection.settimeout(0.01)
        trickling = opened
        while trickling:  # a byte each tenth of a second or so: never silent for long
            trickling = [connection for connection in trickling if stays_open(connection)]
    assert any(is_healthy(port) for _ in range(1000))


def stays_open(connection: socket.socket) -> bool:
    """Whether a connection that gets another byte stays open."""
    try:
        connection.sendall(b"G")
        return connection.recv(1) != b""
    except TimeoutError:
        return True
    except OSError:
        return False


def is_healthy(port: int) -> bool:
    try:
        return get(port, "/healthz").code == 200
    except OSError:
        return False


@contextmanager
def no_space(pid):
    """Every file that the process writes ends after 10 kB, as on a disk that is full."""
    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (10_000, hard))
    yield
    with suppress(ProcessLookupError):
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))


def test_while_the_disk_is_full_it_goes_on_mapping_and_says_so(tmp_path, arguments):
    port = free_port()
    with (
        servers.server_process([*arguments, "--set", f"metrics.port={port}"]) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        servers.learn_all(client, 2)
        kept = client.checkpoint()
        code, report = health(port)
        assert (code, report["problem"]) == (200, None)
        told = report["maps"][servers.MAP]
        assert (told["problem"], told["scans_taken"], told["epoch"]) == (None, 2, kept.epoch)
        stored = set((tmp_path / "store").rglob("*"))
        with no_space(server.process.pid):
            servers.learn(client, 1)
            with pytest.raises(RefusedError, match="cannot be written: .*too large"):
                client.checkpoint()
            code, report = health(port)
            assert code == 503
            assert "cannot be written" in report["problem"]
            assert samples(port)["triquad_healthy", ()] == 0
            assert samples(port)["triquad_checkpoints_total", (("outcome", "failed"),)] == 1
            assert client.metrics().problem == report["problem"]
            status = client.status()
            assert "cannot be written" in status.store_error
            assert status.last_checkpoint == kept
            assert status.epoch > kept.epoch
            assert read_map(kept.path).epoch == kept.epoch
            assert set((tmp_path / "store").rglob("*")) == stored

            assert servers.learn(client, 1).taken == 4
        client.settle(servers.WAIT_S)
        later = client.checkpoint()
        assert health(port)[0] == 200
        assert client.status().store_error is None
        assert read_map(later.path).epoch == later.epoch == client.status().epoch
        servers.learn(client, 1)
        with no_space(server.process.pid):
            server.process.send_signal(signal.SIGTERM)
            assert server.wait() == 5, "the program that started it hears of it"
    assert f"what was mapped since epoch {later.epoch} is lost" in server.log
    assert read_map(later.path).epoch == later.epoch
    assert not list((tmp_path / "store").rglob("*.tmp"))
    assert "Traceback" not in server.log


def test_a_port_that_is_taken_ends_the_server_at_once(arguments):
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with servers.server_process([*arguments, "--metrics-port", port], ready=False) as server:
            assert server.wait() == 3
    assert f"cannot listen on 127.0.0.1:{port} for metrics" in server.log
    assert "--metrics-port" in server.log
    assert "preparing" not in server.log


@pytest.mark.parametrize("address", ["203.0.113.7", "a" * 200, "\0"])
def test_an_address_that_is_not_ours_is_named(address):
    settings = servers.SMALL.model_copy(
        update={"metrics": MetricsSettings(port=free_port(), address=address)}
    )
    with pytest.raises(ListenError, match=re.escape(printable(address))):
        triquad_server.serve(settings=settings)


def test_a_server_within_a_program_closes_its_port():
    port = free_port()
    settings = servers.SMALL.model_copy(
        update={"metrics": MetricsSettings(port=port, address="::1")}
    )
    servers.compiled()
    for _ in range(2):  # the port is free again at once
        with triquad_server.serve(settings=settings):
            url = f"http://[::1]:{port}/healthz"
            with urllib.request.urlopen(url, timeout=servers.WAIT_S) as reply:
                assert reply.status == 200
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("::1", port))


def test_prometheus_client_is_imported_only_where_it_is_wanted():
    script = "import sys, triquad_server.launch; sys.exit('prometheus_client' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
