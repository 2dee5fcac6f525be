"""Ways that are longer than memory: a server keeps to ``memory.max_bytes``, and forgets nothing.

A car drives along a street at 10 m/s, with a scan each 2 m. The first kilometre is scored once it
was driven, and again at the end; in between it leaves memory.
"""

import argparse
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Client, connect
from triquad_format.records.arrays import Doubles
from triquad_tools.console.progress import progress
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.street import street_drive

from bench.clients.served import MAP, around
from bench.clients.server_process import ServerProcess, server_process
from bench.figures import Figure
from bench.street_pieces import PIECE_M, REACH_M, mean_f_score

_STEP_M, _RATE_HZ = 2.0, 5.0
_SENSOR = Lidar(columns=720)
_SCORED_M = 1000.0  # of the way: a piece of it each 200 m
_EACH_M = 200.0
_MOST_WAITING = 16  # scans, before the car waits
_SHARE = 0.1  # of the way, at its start and its end, for the time that scans take
_PLACES = 100
_ASKED = 100  # points around each place
_TIMEOUT_S = 120.0
_WATCH_S = 0.02


@dataclass(frozen=True)
class _Way:
    """A way, and the memory of the server that maps it."""

    name: str
    length_m: float
    max_bytes: int
    settings: tuple[str, ...] = ()  # further ones


_WAYS = (
    _Way("1.6 km with 0.7 GB, regions of 51 m", 1600.0, 700_000_000, ("field.depth=8",)),
    _Way("5 km with 2 GB", 5000.0, 2_000_000_000),
    _Way("20 km with 2 GB", 20_000.0, 2_000_000_000),
)


@dataclass
class _Peak:
    """The most memory that a server had."""

    bytes: int = 0


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of all ways."""
    return [figure for way in _WAYS for figure in _measured(way, options.seed)]


def _measured(way: _Way, seed: int) -> list[Figure]:
    drive = street_drive(seed, int(way.length_m / _STEP_M), _STEP_M, way.length_m, _SENSOR)
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as folder:
        with _served(way, Path(folder)) as (server, client), _watched(server) as peak:
            figures = _driven(way, drive, client)
            server.process.terminate()
            server.wait()
        figures.insert(
            0, Figure(f"{way.name}: most memory", peak.bytes / way.max_bytes, "of it", at_most=1)
        )
        # The system may have dropped the program's own files: one without a map reads them again.
        with tempfile.TemporaryDirectory() as empty, _served(way, Path(empty)):
            pass
        started_s = time.monotonic()
        with _served(way, Path(folder)) as (_, client):
            ready_s = time.monotonic() - started_s
            return [
                *figures,
                Figure(f"{way.name}: ready again after", ready_s, "s", at_most=2),
                *_cold(way, drive, client),
            ]


@contextmanager
def _served(way: _Way, folder: Path) -> Iterator[tuple[ServerProcess, Client]]:
    words: list[str | Path] = ["--map", MAP, "--store", folder]
    for setting in (f"memory.max_bytes={way.max_bytes}", *way.settings):
        words += ["--set", setting]
    with (
        server_process(words) as server,
        connect(server.endpoint, MAP, timeout_s=_TIMEOUT_S) as client,
    ):
        yield server, client


@contextmanager
def _watched(server: ServerProcess) -> Iterator[_Peak]:
    """Look at the memory of a server all the time."""
    peak, over = _Peak(), threading.Event()

    def watch() -> None:
        while not over.wait(_WATCH_S) and server.process.poll() is None:
            peak.bytes = max(peak.bytes, server.resident_bytes)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield peak
    finally:
        over.set()
        thread.join()


def _driven(way: _Way, drive: SimulatedDrive, client: Client) -> list[Figure]:
    """Drive all of a way; return how it went."""
    scored_m = min(_SCORED_M, way.length_m - 2 * REACH_M)
    last, tenth = len(drive), int(_SHARE * len(drive))
    pieces = np.arange(0.0, scored_m - PIECE_M, _EACH_M).tolist()
    seen = int((scored_m + REACH_M) / _STEP_M)
    scans_s: dict[int, float] = {}  # that scans had taken, by the number of scans
    f_driven = float("nan")
    with progress(f"driving {way.name}", last) as report:
        due_s = time.monotonic()
        for number in range(last):
            scan = drive.scan(number)
            time.sleep(max(0.0, due_s - time.monotonic()))
            due_s = max(due_s, time.monotonic()) + 1 / _RATE_HZ
            client.publish_scan(scan.points, scan.world_from_sensor, no_return=scan.no_return)
            if number % _MOST_WAITING == 0:
                client.flush(_TIMEOUT_S, pending=_MOST_WAITING)
            if number in (tenth, last - tenth):
                client.flush(_TIMEOUT_S)
                scans_s[number] = client.metrics().mapper_s["scans"]
            if number == seen:
                f_driven = mean_f_score(drive, client.mesh, pieces)
            report(number, f"{number * _STEP_M:.0f} m")
    flushed = client.flush(_TIMEOUT_S)
    at_end_s = client.metrics().mapper_s["scans"]
    status, metrics = client.status(), client.metrics()
    f_at_end = mean_f_score(drive, client.mesh, pieces)
    first = scans_s[tenth] / (tenth + 1)
    end = (at_end_s - scans_s[last - tenth]) / (tenth - 1)
    lost = len(drive) - flushed.taken
    name = way.name
    return [
        Figure(f"{name}: regions, and in memory of these", status.regions, ""),
        Figure(f"{name}: in memory at the end", status.regions - status.regions_cold, ""),
        Figure(f"{name}: scans not taken", lost, "", at_most=0),
        Figure(f"{name}: F of the first km when it was driven", 100 * f_driven, "%"),
        Figure(f"{name}: less at the end", 100 * (f_driven - f_at_end), "points", at_most=0.3),
        Figure(f"{name}: a scan, first tenth", 1000 * first, "ms"),
        Figure(f"{name}: last tenth, of that", end / first, "", at_most=1.3),
        Figure(f"{name}: last checkpoint", metrics.checkpoints.last_duration_s or 0.0, "s"),
    ]


def _cold(way: _Way, drive: SimulatedDrive, client: Client) -> list[Figure]:
    """Return how soon places are answered that nobody asked about since the start."""
    rng = np.random.default_rng(0)
    count = min(_PLACES, int(way.length_m / _EACH_M))
    numbers = np.linspace(0, len(drive) - 1, count + 2).astype(int)[1:-1]
    rng.shuffle(numbers)
    first, again = [], []
    for number in numbers:
        points: Doubles = around(drive.poses[number, :3, 3], _ASKED, rng)
        first.append(_asked_ms(client, points))
        again.append(_asked_ms(client, points))
    name = f"{way.name}: {count} places"
    return [
        Figure(f"{name}, first answer, median", statistics.median(first), "ms", at_most=150),
        Figure(f"{name}, longest", max(first), "ms"),
        Figure(f"{name}, asked again, median", statistics.median(again), "ms"),
    ]


def _asked_ms(client: Client, points: Doubles) -> float:
    started_s = time.monotonic()
    client.query_sdf(points)
    return 1000 * (time.monotonic() - started_s)
