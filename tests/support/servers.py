"""Real servers and raw Zenoh sessions for the tests, on free ports of the loopback."""

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import triquad_client
import zenoh
from numpy.typing import NDArray
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.mesh_messages import TileChangesRequest
from triquad_format.wire.messages import ErrorReply, FlushReply, FlushRequest, Scan
from triquad_format.wire.zenoh_config import QUIET, put
from triquad_server.launch_options import LaunchOptions
from triquad_server.maps import Maps
from triquad_server.network import NetworkOptions, configuration, open_session
from triquad_server.process.memory_share import ServerMemory
from triquad_server.process.stop import Stop
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
from triquad_server.settings.loading import load_settings
from triquad_server.store.found_map import find_map
from triquad_server.warm_up import warm_up

from bench.clients.server_process import ServerProcess, free_endpoint
from bench.clients.server_process import server_process as process_of

MAP = "default"
WAIT_S = 120.0  # for what takes milliseconds unless something is broken
SMALL_FILE = Path(__file__).with_name("small.toml")
SMALL = load_settings(SMALL_FILE)
LOGGED = load_settings(SMALL_FILE, ["store.log_max_bytes=1000000000"])
"""The same, with scans kept."""
RADIUS_M = 4.0


def sphere(count: int = 4000, radius_m: float = RADIUS_M) -> NDArray[np.float32]:
    """Points [count, 3] of a sphere around the sensor."""
    directions = np.random.default_rng(1).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (radius_m * directions).astype(np.float32)


def learn(client: triquad_client.Client, scans: int = 2) -> triquad_client.FlushReport:
    """Have the server take in some scans of a sphere around the map's origin."""
    for _ in range(scans):
        client.publish_scan(sphere(), np.eye(4))
    return client.flush(WAIT_S)


def learn_all(
    client: triquad_client.Client,
    scans: int = 3,
    points: NDArray[np.float32] | None = None,
    pose: NDArray[np.float64] | None = None,
) -> triquad_client.ServerStatus:
    """Have the server take in some scans, of a sphere unless points are given, and settle."""
    for _ in range(scans):
        client.publish_scan(
            sphere() if points is None else points, np.eye(4) if pose is None else pose
        )
    return client.settle(WAIT_S)


def assert_same_map(before: triquad_client.SdfResult, after: triquad_client.SdfResult) -> None:
    assert after.epoch >= before.epoch
    assert np.array_equal(after.status, before.status)
    assert np.allclose(after.sdf, before.sdf, rtol=0, atol=2e-3)  # features in half precision


def until(
    is_so: Callable[[], bool], told: Callable[[], object] = str, within_s: float = WAIT_S
) -> None:
    """Return once something is so; what is ``told`` of it where that takes too long."""
    ends_s = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < ends_s, told()
        time.sleep(0.01)


@cache
def compiled() -> None:
    """Have all kernels compiled: at the first start that takes longer than a request may."""
    warm_up(SMALL, "cpu")


@contextmanager
def running_service(
    settings: Settings = SMALL,
    map_name: str = MAP,
    store: Path | None = None,
    connect: tuple[str, ...] = (),
    endpoint: str | None = None,
) -> Iterator[str]:
    """A service in this process; yields its endpoint, a free one unless it is given."""
    compiled()
    endpoint = endpoint or free_endpoint()
    network = NetworkOptions((endpoint,), connect)
    options = LaunchOptions((map_name,), network, settings, store, device="cpu")
    memory, stops = ServerMemory(settings.memory.max_bytes), queue.SimpleQueue[Stop]()
    with (
        closing(Teams()) as teams,
        closing(open_session(configuration(network, settings))) as session,
        closing(Maps(session, options, teams, memory, failed=stops.put)) as maps,
    ):
        maps.begin([find_map(map_name, settings, store, memory=memory, split=teams.answer)])
        yield endpoint


@contextmanager
def service_and_client(
    settings: Settings = SMALL,
    store: Path | None = None,
) -> Iterator[triquad_client.Client]:
    """A service in this process, and a client of it."""
    with (
        running_service(settings, store=store) as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        yield client


@contextmanager
def raw_session(
    mode: str = "client",
    connect: str | None = None,
    listen: str | None = None,
    timestamps: bool = False,
    access_control: dict[str, Any] | None = None,
) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    if access_control is not None:
        put(config, {"access_control": access_control})
    endpoints = {"listen": [listen] if listen else [], "connect": [connect] if connect else []}
    values = {f"{kind}/endpoints": there for kind, there in endpoints.items()}
    delay = {"scouting/delay": 1}  # ms: a router would wait for half a second for others
    put(config, {**QUIET, **delay, **values, "mode": mode, "timestamping/enabled": timestamps})
    with zenoh.open(config) as session:
        yield session


@contextmanager
def answering(answers: dict[str, Callable[[zenoh.Query, str], None]]) -> Iterator[str]:
    """A router that claims to have the default map, and answers by hand; yields its endpoint."""
    endpoint = free_endpoint()
    with raw_session("router", listen=endpoint) as session:
        token = session.liveliness().declare_token(keys.alive_key(MAP, "x"))
        queryables, threads = [], []
        for operation, answer in answers.items():
            key = keys.operation_key(MAP, operation)
            queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(16))
            queryables.append(queryable)

            def serve(
                queryable: "zenoh.Queryable[Any]" = queryable,
                key: str = key,
                answer: Callable[[zenoh.Query, str], None] = answer,
            ) -> None:
                for query in queryable:
                    answer(query, key)

            threads.append(threading.Thread(target=serve))
            threads[-1].start()
        yield endpoint
        for queryable in queryables:
            queryable.undeclare()
        for thread in threads:
            thread.join()
        token.undeclare()


@dataclass
class RawPeer:
    """Speaks the wire protocol by hand, to say what the client never would."""

    session: zenoh.Session
    map_name: str = MAP

    def put(self, source: str, payload: bytes) -> None:
        self.session.put(
            keys.scan_key(self.map_name, source),
            payload,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def ask(self, operation: str, payload: bytes | None) -> bytes | ErrorReply | None:
        """The reply's payload, the refusal, or ``None`` for silence."""
        key = keys.operation_key(self.map_name, operation)
        for reply in self.session.get(key, payload=payload, timeout=WAIT_S):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            return codec.decode(ErrorReply, reply.err.payload.to_bytes())
        return None

    def refusal(self, operation: str, request: Message | bytes) -> str:
        """The code with which a request is refused."""
        payload = request if isinstance(request, bytes) else codec.encode(request)
        answer = self.ask(operation, payload)
        assert isinstance(answer, ErrorReply), answer
        return answer.code

    def flush(self, scan: Scan) -> FlushReply:
        started = time.monotonic()
        while True:
            waited_s = time.monotonic() - started
            assert waited_s < WAIT_S
            request = FlushRequest(scan.source, scan.session, scan.sequence, waited_s)
            answer = self.ask(keys.FLUSH, codec.encode(request))
            assert isinstance(answer, bytes), answer
            reply = codec.decode(FlushReply, answer)
            if reply.done:
                return reply
            time.sleep(0.02)


def scan(sequence: int = 0, **changes: object) -> Scan:
    """A good scan, but for ``changes``."""
    good = Scan(sphere(500), np.eye(4), 1_000 + sequence, "lidar", 7, sequence)
    return replace(good, **changes)  # type: ignore[arg-type]


def tile_changes(**changes: object) -> TileChangesRequest:
    """A good request for all of a map's mesh, but for ``changes``."""
    everywhere = np.full(3, -np.inf), np.full(3, np.inf)
    good = TileChangesRequest(*everywhere, level=0, server="", since=0)
    return replace(good, **changes)  # type: ignore[arg-type]


@contextmanager
def server_process(
    arguments: Sequence[str | Path] = (), *more: Any, **options: Any
) -> Iterator[ServerProcess]:
    """A server process that trains on the CPU; with options as those of :mod:`bench`.

    Without an environment of its own all is compiled before.
    """
    if options.get("environment") is None:
        compiled()
    with process_of(["--device", "cpu", *arguments], *more, **options) as server:
        yield server
