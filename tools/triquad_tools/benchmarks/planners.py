"""``triquad-bench`` of planners: one, sixteen at once while a lidar streams, and a frozen one."""

import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import zenoh
from triquad_client import Client, connect
from triquad_format.mapfile.mapfile import read_map
from triquad_format.wire import keys
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

from triquad_tools.benchmarks.answers import REACH_M, measure_answers
from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import BenchStreet, stream
from triquad_tools.console.settling import wait_until_settled
from triquad_tools.demo.probe import Probe, ProbeReport
from triquad_tools.demo.server import DemoServer, ServerOptions, free_endpoint

_MAP = "bench"
_ASKED = 1_000
_CLIENTS = 16
_SETTLE_LIMIT_S = 600.0
_WARM_S = 3.0  # until sixteen processes have started
_FREEZE_AFTER_S = 0.5
_FROZEN = """
import sys, triquad_client
with triquad_client.connect(sys.argv[1], sys.argv[2], timeout_s=60.0) as client:
    print("asking", flush=True)
    while True:
        client.mesh()
"""


def measure_planners(made: BenchStreet) -> list[Figure]:
    """Figures of answers, and of how soon they come."""
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        folder = Path(name)
        options = ServerOptions(free_endpoint(), _MAP, folder / "store", folder / "server.log")
        with (
            DemoServer(options) as server,
            connect(server.endpoint, _MAP, timeout_s=60.0) as client,
        ):
            drive = _Drive(client, made)
            points = _planner_points(made, folder)
            figures = _one(drive, server.endpoint, points)
            figures += _sixteen(drive, server.endpoint, points)
            figures += _beside_frozen(client, server.endpoint, points)
            wait_until_settled(client, _SETTLE_LIMIT_S)
            client.download_map(folder / "map.triquad")
        record = read_map(folder / "map.triquad")
        view = Mapper(_MAP, Settings(), "cpu", record).publish()
        return measure_answers(made, record, view) + figures


class _Drive:
    """The drive, streamed at the lidar's rate, again and again."""

    def __init__(self, client: Client, made: BenchStreet) -> None:
        self._client = client
        self._made = made

    def stream(self, name: str) -> float:
        """Stream all scans; returns how many samples were trained each second meanwhile."""
        before = self._client.status().samples_trained
        started = time.monotonic()
        stream(self._client, self._made.scans, name)
        trained = self._client.status().samples_trained - before
        return trained / (time.monotonic() - started)


def _planner_points(made: BenchStreet, folder: Path) -> list[Path]:
    """Files of what each planner asks: points around one place of the drive each."""
    rng = np.random.default_rng(0)
    paths = []
    for number in range(_CLIENTS):
        pose = made.drive.poses[number * len(made.drive.poses) // _CLIENTS]
        points = pose[:3, 3] + rng.uniform((-8, -8, -1.5), (8, 8, 2.0), (_ASKED, 3))
        paths.append(folder / f"points-{number}.npy")
        np.save(paths[-1], points)
    return paths


def _one(drive: _Drive, endpoint: str, points: Sequence[Path]) -> list[Figure]:
    drive.stream("streaming alone at first")
    with Probe(endpoint, _MAP, points[0], "distance") as probe:
        time.sleep(_WARM_S)
        drive.stream("streaming beside one planner")
        met = probe.finish()
    name = f"{_ASKED} distances to {REACH_M:g} m with gradient while streaming"
    return [
        Figure(f"{name}, median", met.latency_p50_ms, "ms", at_most=5),
        Figure(f"{name}, 99 %", met.latency_p99_ms, "ms", at_most=20),
        Figure(f"{name}, longest of {met.queries}", met.latency_max_ms, "ms"),
        Figure(f"{name}, errors", met.errors, "", at_most=0),
    ]


def _sixteen(drive: _Drive, endpoint: str, points: Sequence[Path]) -> list[Figure]:
    alone = drive.stream("streaming alone")
    figures = [Figure("samples trained while streaming alone", alone / 1e6, "M/s")]
    for question in ("gradient", "distance"):
        with ExitStack() as probes:
            asking = [
                probes.enter_context(Probe(endpoint, _MAP, path, question)) for path in points
            ]
            time.sleep(2 * _WARM_S)
            trained = drive.stream(f"streaming beside {_CLIENTS} planners ({question})")
            met = [probe.finish() for probe in asking]
        figures += _met_together(f"{_CLIENTS} clients, {question}", met)
        figures.append(
            Figure(f"{_CLIENTS} clients, {question}: training keeps", trained / alone, "",
                   at_least=0.5)
        )  # fmt: skip
    return figures


def _met_together(name: str, met: Sequence[ProbeReport]) -> list[Figure]:
    return [
        Figure(f"{name}: queries of {_ASKED} points", sum(report.queries for report in met), ""),
        Figure(f"{name}: errors", sum(report.errors for report in met), "", at_most=0),
        Figure(f"{name}: median of the clients' medians",
               float(np.median([report.latency_p50_ms for report in met])), "ms"),
        Figure(f"{name}: 99 % of the worst client",
               max(report.latency_p99_ms for report in met), "ms", at_most=60),
    ]  # fmt: skip


def _beside_frozen(client: Client, endpoint: str, points: Sequence[Path]) -> list[Figure]:
    """What a client that freezes in the middle of a mesh does to the others."""
    wait_until_settled(client, _SETTLE_LIMIT_S)

    def ask() -> tuple[ProbeReport, int]:
        with (
            Probe(endpoint, _MAP, points[0], "distance") as probe,
            _samples(endpoint) as count,
        ):
            time.sleep(15.0)
            return probe.finish(), count()

    with _mesh_reader(endpoint) as reader:
        beside, samples = ask()
        reader.send_signal(signal.SIGSTOP)
        frozen, frozen_samples = ask()
    ratio = frozen.latency_p99_ms / beside.latency_p99_ms
    return [
        Figure("beside a client that fetches meshes, 99 %", beside.latency_p99_ms, "ms"),
        Figure("beside one frozen in the middle of a mesh, 99 %", frozen.latency_p99_ms, "ms"),
        Figure("the same, times", ratio, "", at_most=1.5),
        Figure("the same, errors", frozen.errors, "", at_most=0),
        Figure("status samples lost meanwhile", max(0, samples - frozen_samples - 1), "",
               at_most=0),
    ]  # fmt: skip


@contextmanager
def _mesh_reader(endpoint: str) -> Iterator["subprocess.Popen[str]"]:
    """A process that fetches meshes all the time."""
    command = [sys.executable, "-c", _FROZEN, endpoint, _MAP]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(_FREEZE_AFTER_S)
            yield process
        finally:
            process.kill()


@contextmanager
def _samples(endpoint: str) -> Iterator[Callable[[], int]]:
    """Counts the status samples that come."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    lock = threading.Lock()
    received = 0

    def take(_sample: zenoh.Sample) -> None:
        nonlocal received
        with lock:
            received += 1

    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(
            keys.status_key(_MAP), zenoh.handlers.Callback(take, indirect=False)
        )
        yield lambda: received
        subscriber.undeclare()
