"""Real servers and raw Zenoh sessions for the tests, on free ports of the loopback."""

import os
import queue
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import triquad_client
import zenoh
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import ErrorReply, FlushReply, FlushRequest, Scan
from triquad_format.wire.zenoh_config import QUIET, put
from triquad_server.mapping.mapper import Mapper
from triquad_server.network import NetworkOptions, configuration, open_session
from triquad_server.service import ServedMap, Service
from triquad_server.settings import Settings, TrainingSettings
from triquad_server.store.restore import ValidCheckpoint
from triquad_server.store.store import Store
from triquad_server.warm_up import warm_up

MAP = "default"
WAIT_S = 120.0  # for what takes milliseconds unless something is broken
SMALL = Settings(
    field=FieldSettings(depth=7),
    training=TrainingSettings(batch=2048, samples_per_ray=10.0, pool_bytes=480_000),
)
SMALL_TOML = (
    "[field]\ndepth = 7\n[training]\nbatch = 2048\nsamples_per_ray = 10.0\npool_bytes = 480000\n"
)
RADIUS_M = 4.0


def free_port() -> int:
    """A port of the loopback that nothing uses."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def free_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


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
    network = configuration(NetworkOptions((endpoint,), connect), map_name, settings)
    opened = Store(store, map_name, settings.store) if store else None
    restored: ValidCheckpoint | None = opened.newest() if opened else None
    mapper = Mapper(map_name, settings, "cpu", restored.record if restored else None)
    info = restored.info if restored else None
    session = open_session(network)
    try:
        with closing(Service(session, ServedMap(map_name, mapper, "cpu", opened, info), settings)):
            yield endpoint
    finally:
        session.close()
        if opened:
            opened.close()


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


@dataclass
class ServerProcess:
    """A ``triquad-server`` process whose log is read as it comes."""

    process: subprocess.Popen[str]
    endpoint: str
    lines: list[str] = field(default_factory=list)
    _news: "queue.SimpleQueue[str | None]" = field(default_factory=queue.SimpleQueue)

    def __post_init__(self) -> None:
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    @property
    def log(self) -> str:
        return "".join(self.lines)

    @property
    def resident_bytes(self) -> int:
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * resource.getpagesize()

    def wait_for(self, text: str) -> None:
        """Return once a line holds ``text``."""
        while (line := self._news.get(timeout=WAIT_S)) is not None:
            if text in line:
                return
        raise AssertionError(f"the server ended without {text!r}:\n{self.log}")

    def wait(self) -> int:
        """The exit code, once it ends."""
        code = self.process.wait(WAIT_S)
        self._reader.join()
        return code

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            self._news.put(line)
        self._news.put(None)


@contextmanager
def server_process(
    arguments: Sequence[str | Path] = (),
    endpoint: str | None = None,
    ready: bool = True,
    environment: Mapping[str, str] | None = None,
) -> Iterator[ServerProcess]:
    """A server process; killed at the end if it still runs.

    ``environment`` has variables beside those of this process; without any all is compiled before.
    """
    if environment is None:
        compiled()
    endpoint = endpoint or free_endpoint()
    command = [sys.executable, "-m", "triquad_server.cli", "--listen", endpoint]
    command += ["--device", "cpu", *map(str, arguments)]
    variables = {**os.environ, **(environment or {})}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=variables) as process:
        server = ServerProcess(process, endpoint)
        try:
            if ready:
                server.wait_for("ready: ")
            yield server
        finally:
            if process.poll() is None:
                process.kill()
            server.wait()
