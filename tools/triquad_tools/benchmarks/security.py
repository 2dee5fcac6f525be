"""``triquad-bench`` of what roles cost: TLS with certificates on both sides, against plain TCP.

Two servers run at once and are asked in turns, so that both meet the same noise.
"""

import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from triquad_client import Client, connect
from triquad_format.wire.roles import Holder, Role
from triquad_sensors.sweep import PosedScan

from triquad_tools.benchmarks.figures import Figure, seconds
from triquad_tools.benchmarks.street import BenchStreet
from triquad_tools.credentials.key_folder import KeyFolder
from triquad_tools.demo.server import DemoServer, free_endpoint
from triquad_tools.recordings.publishing import publish_all, wait_until_settled

_MAP = "bench"
_SOURCE = "default"
_DAYS = 1.0
_TURNS = 5  # of scans
_SETTLE_LIMIT_S = 300.0
_ASKED = 1_000
_QUERIES = 400
_CONNECTIONS = 20
_TIMEOUT_S = 60.0


def measure_security(made: BenchStreet) -> list[Figure]:
    """Figures of queries, scans and connections with roles and without."""
    with (
        tempfile.TemporaryDirectory(prefix="triquad-bench-") as name,
        _plain(Path(name) / "plain") as plain,
        _guarded(Path(name) / "tls") as guarded,
    ):
        figures = _scans(plain.client, guarded.client, made.scans)
        for server in (plain, guarded):
            wait_until_settled(server.client, _SETTLE_LIMIT_S)
        return figures + _queries(plain, guarded, made) + _connections(plain, guarded)


class _Server:
    """A server that one connects to with a configuration, or without."""

    def __init__(self, endpoint: str, config: Path | None) -> None:
        self._endpoint, self._config = endpoint, config
        self.client = self.connect()

    def connect(self) -> Client:
        """Another client."""
        return connect(self._endpoint, _MAP, timeout_s=_TIMEOUT_S, config=self._config)


@contextmanager
def _plain(folder: Path) -> Iterator[_Server]:
    folder.mkdir()
    with DemoServer(folder, _MAP) as running, ExitStack() as end:
        server = _Server(running.endpoint, None)
        end.enter_context(server.client)
        yield server


@contextmanager
def _guarded(folder: Path) -> Iterator[_Server]:
    """With a role that may publish."""
    keys = KeyFolder.create(folder, [], _DAYS)
    config = keys.add(Holder("robot", Role.ROBOT, (_SOURCE,)), _DAYS)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    arguments = ["--config", str(folder / "server.json5")]
    with DemoServer(folder, _MAP, arguments, endpoint) as running, ExitStack() as end:
        server = _Server(running.endpoint, config)
        end.enter_context(server.client)
        yield server


def _scans(plain: Client, guarded: Client, scans: Sequence[PosedScan]) -> list[Figure]:
    """How many are taken in each second, where the server sets the pace."""
    took_s = {plain: 0.0, guarded: 0.0}
    for number in range(_TURNS):
        for client in took_s:
            part = scans[number * len(scans) // _TURNS : (number + 1) * len(scans) // _TURNS]
            took_s[client] += seconds(partial(publish_all, client, part))
    rates = {client: len(scans) / total for client, total in took_s.items()}
    return [
        Figure("scans taken in, plain TCP", rates[plain], "/s"),
        Figure("scans taken in, with roles", rates[guarded], "/s"),
        Figure("the same, times that of plain TCP", rates[guarded] / rates[plain], "",
               at_least=0.9),
    ]  # fmt: skip


def _queries(plain: _Server, guarded: _Server, made: BenchStreet) -> list[Figure]:
    points = np.random.default_rng(0).permutation(made.probes.near)[:_ASKED]
    times_ms: dict[str, list[float]] = {"plain TCP": [], "with roles": []}
    for _ in range(_QUERIES):
        for name, server in zip(times_ms, (plain, guarded), strict=True):
            asking_s = seconds(partial(server.client.query_distance, points))
            times_ms[name].append(1e3 * asking_s)
    quantiles = {name: np.quantile(times, [0.5, 0.99]) for name, times in times_ms.items()}
    figures = []
    for name, (half, most) in quantiles.items():
        figures.append(Figure(f"{_ASKED} distances, {name}, median", float(half), "ms"))
        figures.append(Figure(f"{_ASKED} distances, {name}, 99 %", float(most), "ms"))
    added = quantiles["with roles"][0] - quantiles["plain TCP"][0]
    return [*figures, Figure("what roles add to the median", float(added), "ms", at_most=0.5)]


def _connections(plain: _Server, guarded: _Server) -> list[Figure]:
    figures = []
    for name, server in (("plain TCP", plain), ("with roles", guarded)):
        times_ms = []
        for _ in range(_CONNECTIONS):
            started = time.perf_counter()
            with server.connect():
                times_ms.append(1e3 * (time.perf_counter() - started))
        figures.append(Figure(f"connect, {name}, median", statistics.median(times_ms), "ms"))
    return figures
