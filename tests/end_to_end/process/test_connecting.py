"""A client that is started together with its server, or before it is ready."""

import logging
import queue
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from threading import Event

import pytest
import triquad_client
from support import servers
from triquad_client import ConnectError
from triquad_client.net import opening
from triquad_server.launch import opened
from triquad_server.launch_options import LaunchOptions
from triquad_server.network import NetworkOptions

STAGE = "opening the map"


@contextmanager
def held_start(endpoint: str, let: Event) -> Iterator[None]:
    """A server that starts, and waits before it opens its map."""
    begun = Event()

    def hold(stage: str) -> None:
        if stage == STAGE:
            begun.set()
            assert let.wait(servers.WAIT_S)

    network = NetworkOptions(listen=(endpoint,))
    options = LaunchOptions((servers.MAP,), network, servers.SMALL, store=None, device="cpu")
    over = Event()

    def serve() -> None:
        with opened(options, queue.SimpleQueue(), hold):
            over.wait(servers.WAIT_S)

    with ThreadPoolExecutor(1) as pool:
        server = pool.submit(serve)
        try:
            assert begun.wait(servers.WAIT_S)
            yield
        finally:
            let.set()
            over.set()
            server.result(servers.WAIT_S)


def test_a_client_may_be_started_with_its_server() -> None:
    with (
        servers.server_process(ready=False) as server,
        triquad_client.connect(server.endpoint, timeout_s=servers.WAIT_S) as client,
    ):
        assert client.status().epoch >= 1
        server.process.kill()


def test_a_client_of_a_starting_server_waits_and_is_told_what_it_does(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    servers.compiled()
    monkeypatch.setattr(opening, "_TOLD_AFTER_S", -1.0)
    endpoint, let = servers.free_endpoint(), Event()
    with held_start(endpoint, let), ThreadPoolExecutor(1) as pool:
        told = f"map 'default' is starting: {STAGE}; connect again"
        with pytest.raises(ConnectError, match=told):
            triquad_client.connect(endpoint, timeout_s=0.3)
        caplog.clear()
        monkeypatch.setattr(opening, "_USUAL_S", 0.3)
        patient = pool.submit(triquad_client.connect, endpoint)
        servers.until(lambda: f"is starting: {STAGE}; waiting for 600 s" in caplog.text)
        # Longer than a server is waited for that is not there.
        assert wait([patient], timeout=1.0).not_done
        assert caplog.records[0].levelno == logging.WARNING
        let.set()
        with patient.result(servers.WAIT_S) as client:
            assert client.status().epoch >= 1
