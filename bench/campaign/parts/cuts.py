"""A network that drops connections amid messages, and stalls them."""

import contextlib
import threading
import time
from contextlib import closing

import numpy as np
import triquad_client
from support import servers
from triquad_client import TriquadError

from bench.campaign.cutting_proxy import CuttingProxy
from bench.campaign.server_under_test import (
    WITHIN_S,
    expect,
    expect_honest_service,
    expect_known,
    expect_steady_memory,
    learnt_server,
    sphere_at,
)
from bench.campaign.turn import BrokenError, Turn

_PLACES = 4


def run(turn: Turn) -> None:
    """Cut connections under load; after each cut clients are served again."""
    with learnt_server(turn) as server, closing(CuttingProxy(server.endpoint)) as proxy:
        before = server.resident_bytes
        while not turn.over:
            _cut_amid_load(turn, proxy)
        expect_steady_memory(turn, before, server.resident_bytes)
        expect_honest_service(server.endpoint)


def _cut_amid_load(turn: Turn, proxy: CuttingProxy) -> None:
    place = turn.random.randrange(_PLACES)
    stopping = threading.Event()
    with triquad_client.connect(proxy.endpoint, timeout_s=5.0) as client:
        failures: list[str] = []
        load = threading.Thread(target=_load, args=(client, place, stopping, failures))
        load.start()
        try:
            for _ in range(min(5, turn.most)):
                time.sleep(turn.random.uniform(0, 0.1))
                if turn.random.random() < 0.3:
                    proxy.hold()
                    time.sleep(turn.random.uniform(0, 0.3))
                turn.did("cut", proxy.cut())
                proxy.heal()
        finally:
            stopping.set()
            load.join()
        for text in failures:
            turn.broke(text)
        _expect_served_again(client, place)


def _load(
    client: triquad_client.Client, place: int, stopping: threading.Event, failures: list[str]
) -> None:
    """Publish and ask; errors of triquad are allowed, but no others."""
    queries = servers.sphere(20_000)
    while not stopping.is_set():
        try:
            client.publish_scan(*sphere_at(place))
            client.query_sdf(queries)
        except TriquadError:
            continue
        except Exception as error:
            failures.append(f"a client met {type(error).__name__}: {error}")
            return


def _expect_served_again(client: triquad_client.Client, place: int) -> None:
    """Expect the same client to reconnect in time, and what it flushes to be in the map."""
    by = time.monotonic() + WITHIN_S
    while time.monotonic() < by:
        with contextlib.suppress(TriquadError):
            before = client.flush(5.0).taken
            client.publish_scan(*sphere_at(place))
            if client.flush(5.0).taken == before + 1:
                expect_known(client, place)
                expect(bool(np.isfinite(client.query_sdf(servers.sphere(5)).sdf).all()), "no sdf")
                return
        time.sleep(0.05)
    raise BrokenError(f"a client was not served again within {WITHIN_S:g} s of the cuts")
