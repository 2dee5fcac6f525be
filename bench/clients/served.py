"""A server process with a client, and a lidar that streams to it."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Client, connect
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles
from triquad_format.records.region import MapRecord
from triquad_tools.demo.probe import Probe, ProbeReport
from triquad_tools.recordings.publishing import publish_all
from triquad_tools.recordings.recording import DEFAULT_SOURCE, ScanEntry
from triquad_tools.sensors.sweep import PosedScan

from bench.clients.server_process import server_process
from bench.figures import Figure
from bench.street_scores import DrivenStreet

MAP = "bench"

_RATE_HZ = 10.0
_TIMEOUT_S = 60.0
_ASKED = 1_000


@dataclass(frozen=True)
class Served:
    """A running server."""

    folder: Path  # for whatever is measured
    endpoint: str
    client: Client

    def another_client(self) -> Client:
        """Return a client of its own, for a ``with`` statement."""
        return connect(self.endpoint, MAP, timeout_s=_TIMEOUT_S)

    def planner(self, points: Doubles, question: str) -> Probe:
        """Return a process that asks a question at points [N, 3], for a ``with`` statement."""
        return Probe(self.endpoint, MAP, points, question=question)


def around(place: Doubles, count: int, rng: np.random.Generator) -> Doubles:
    """Return N points [N, 3] around a place [3] of a drive, as a planner asks for."""
    return place + rng.uniform((-8, -8, -1.5), (8, 8, 2.0), (count, 3))


def near_surface(made: DrivenStreet) -> Doubles:
    """Return 1,000 points [N, 3] near the street's surface."""
    return np.random.default_rng(0).permutation(made.probes.near)[:_ASKED]


@contextmanager
def served(record: MapRecord | None = None, arguments: Sequence[str] = ()) -> Iterator[Served]:
    """Yield a server with an empty map or that of a record, in a folder that is deleted at last.

    ``arguments`` are further ones of its command line.
    """
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        folder = Path(name)
        if record is not None:
            store = folder / "store" / MAP
            store.mkdir(parents=True)
            write_map(record, store / f"epoch-{record.epoch:09d}.triquad")
        with (
            server_process(["--map", MAP, "--store", folder / "store", *arguments]) as server,
            connect(server.endpoint, MAP, timeout_s=_TIMEOUT_S) as client,
        ):
            yield Served(folder, server.endpoint, client)


def stream(
    client: Client,
    scans: Sequence[PosedScan],
    title: str = "streaming at 10 Hz",
    published: Callable[[int], None] = lambda _: None,
) -> None:
    """Publish scans as a lidar does; ``published`` is called with the number of each."""
    due_s = [number / _RATE_HZ for number in range(len(scans))]
    started_ns = time.time_ns()

    def outgoing() -> Iterator[tuple[ScanEntry, PosedScan]]:
        for number, scan in enumerate(scans):
            yield ScanEntry(started_ns + round(1e9 * due_s[number]), DEFAULT_SOURCE), scan
            published(number)

    publish_all(client, outgoing(), len(scans), due_s, title)


def stream_beside_planner(
    server: Served, made: DrivenStreet, published: Callable[[int], None] = lambda _: None
) -> ProbeReport:
    """Stream the street while a planner asks for 1,000 gradients, and report what it met."""
    with server.planner(near_surface(made), "gradient") as probe:
        stream(server.client, made.scans, published=published)
        return probe.finish()


def latency_figures(
    name: str,
    met: ProbeReport,
    *,
    median_ms: float | None = None,
    tail_ms: float | None = None,
    longest_ms: float | None = None,
) -> list[Figure]:
    """Return how soon a planner was answered, and what the median, 99 % and all should be."""
    return [
        Figure(f"{name}, median", met.latency_p50_ms, "ms", at_most=median_ms),
        Figure(f"{name}, 99 %", met.latency_p99_ms, "ms", at_most=tail_ms),
        Figure(f"{name}, longest of {met.queries}", met.latency_max_ms, "ms", at_most=longest_ms),
        Figure(f"{name}, errors", met.errors, "", at_most=0),
    ]
