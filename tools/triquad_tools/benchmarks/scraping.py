"""``triquad-bench`` of what it costs a planner that Prometheus reads the server's metrics."""

import statistics
import threading
import time
import urllib.request
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from triquad_client import Client
from triquad_format.records.arrays import Doubles

from triquad_tools.benchmarks.figures import Figure, seconds
from triquad_tools.benchmarks.served import served, stream
from triquad_tools.benchmarks.street import BenchStreet
from triquad_tools.demo.probe import PERIOD_S
from triquad_tools.demo.server import free_port

_RATES_HZ = (0, 1, 10)  # of scrapes
_SLICE_S = 2.0  # then it is the next rate's turn, so that all meet the same noise
_STREAMS = 18
_IDLE_S = 0.05
_ASKED = 1_000
_TIMEOUT_S = 10.0


def measure_scraping(made: BenchStreet) -> list[Figure]:
    """Figures of a planner while scans stream in, with and without scrapes, in turns."""
    port = free_port()
    points = np.random.default_rng(0).permutation(made.probes.near)[:_ASKED]
    with served(arguments=["--metrics-port", str(port)]) as server:
        stream(server.client, made.scans, "streaming alone at first")
        with server.another_client() as planner, _Turns(planner, points, port) as turns:
            for number in range(_STREAMS):
                stream(server.client, made.scans, f"streaming, {number + 1} of {_STREAMS}")
        asked_s = [seconds(server.client.metrics) for _ in range(15)]
    alone = turns.latencies_s[0]
    return [
        Figure("client.metrics()", 1e3 * statistics.median(asked_s), "ms"),
        Figure("scrape while streaming, median", 1e3 * statistics.median(turns.scrapes_s), "ms"),
        *(figure for rate_hz in _RATES_HZ for figure in _beside(rate_hz, turns, alone)),
    ]


def _beside(rate_hz: int, turns: "_Turns", alone: list[float]) -> list[Figure]:
    """What the planner met at a rate of scrapes, beside what it met ``alone`` [seconds]."""
    name = f"1,000 gradients while streaming, {rate_hz or 'no'} scrapes a second"
    half_ms, most_ms = 1e3 * np.quantile(turns.latencies_s[rate_hz], [0.5, 0.99])
    figures = [
        Figure(f"{name}, median", float(half_ms), "ms"),
        Figure(f"{name}, 99 % of {len(turns.latencies_s[rate_hz])}", float(most_ms), "ms"),
    ]
    if rate_hz:
        alone_half_ms, alone_most_ms = 1e3 * np.quantile(alone, [0.5, 0.99])
        figures += [
            Figure(f"{name}, median times that without", float(half_ms / alone_half_ms), "",
                   at_most=1.05),
            Figure(f"{name}, 99 % times that without", float(most_ms / alone_most_ms), "",
                   at_most=1.2),
        ]  # fmt: skip
    return figures


class _Turns:
    """A planner and a scraper beside it, at one rate after the other; a context of both."""

    def __init__(self, planner: Client, points: Doubles, port: int) -> None:
        """The planner asks at ``points`` [N, 3]; metrics are read at ``port``."""
        self.latencies_s: dict[int, list[float]] = {rate_hz: [] for rate_hz in _RATES_HZ}
        self.scrapes_s: list[float] = []
        self._planner, self._points, self._port = planner, points, port
        self._started_s = time.monotonic()
        self._stop = threading.Event()
        self._threads = ThreadPoolExecutor(2)
        self._running: list[Future[None]] = []

    def __enter__(self) -> "_Turns":
        self._running = [self._threads.submit(self._ask), self._threads.submit(self._scrape)]
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._threads.shutdown()
        for thread in self._running:
            thread.result()  # raises what ended it early

    def _rate_hz(self) -> int:
        """Whose turn it is."""
        slices = int((time.monotonic() - self._started_s) / _SLICE_S)
        return _RATES_HZ[slices % len(_RATES_HZ)]

    def _ask(self) -> None:
        took_s = 0.0
        while not self._stop.wait(PERIOD_S - took_s):
            rate_hz = self._rate_hz()
            took_s = seconds(lambda: self._planner.query_sdf(self._points, gradient=True))
            self.latencies_s[rate_hz].append(took_s)

    def _scrape(self) -> None:
        wait_s = 0.0
        while not self._stop.wait(wait_s):
            rate_hz = self._rate_hz()
            took_s = seconds(self._read) if rate_hz else 0.0
            if rate_hz:
                self.scrapes_s.append(took_s)
            wait_s = max(0.0, 1 / rate_hz - took_s) if rate_hz else _IDLE_S

    def _read(self) -> bytes:
        url = f"http://127.0.0.1:{self._port}/metrics"
        with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as reply:
            text: bytes = reply.read()
        return text
