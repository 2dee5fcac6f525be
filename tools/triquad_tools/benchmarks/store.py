"""``triquad-bench`` of checkpoints: a map of 16 regions while the robot drives on in one."""

import dataclasses
import statistics
import tempfile
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Client, connect
from triquad_format.mapfile.history import checkpoint_name
from triquad_format.mapfile.mapfile import write_map
from triquad_format.records.region import MapRecord
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_server.store.retention import Retention
from triquad_server.store.store import Store
from triquad_server.warm_up import warm_up

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import BenchStreet, stream
from triquad_tools.demo.probe import Probe, ProbeReport
from triquad_tools.demo.server import DemoServer, ServerOptions, free_endpoint

_MAP = "bench"
_REGIONS = 16
_SCANS = 40  # that made the map
_SAMPLES = 6_000_000
_ASKED = 1_000
_CHECKPOINTS = 6
_EVERY_SCANS = 15


def measure_store(made: BenchStreet) -> list[Figure]:
    """Figures of checkpoints."""
    record = _row(made)
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        figures = _costs(record, made, Path(name) / "costs")
        return figures + _latencies(record, made, Path(name) / "served")


def _row(made: BenchStreet) -> MapRecord:
    """A street's region, settled, 16 times in a row."""
    settings = Settings()
    warm_up(settings, "cpu")
    mapper = Mapper(_MAP, settings, "cpu")
    for scan in made.scans[:_SCANS]:
        mapper.ingest(scan.points, scan.world_from_sensor)
    while mapper.samples_trained < _SAMPLES:
        mapper.train()
    record = mapper.changes_since(None).record
    (region,) = record.regions
    training = region.training
    assert training is not None
    settled = dataclasses.replace(region, training=dataclasses.replace(training, visits_owed=0))
    return dataclasses.replace(
        record,
        regions=tuple(
            dataclasses.replace(settled, index=(number, 0, 0)) for number in range(_REGIONS)
        ),
    )


def _costs(record: MapRecord, made: BenchStreet, root: Path) -> list[Figure]:
    """Bytes and time of a complete checkpoint, and of those after driving on in one region."""
    mapper = Mapper(_MAP, Settings(), "cpu", record)
    with closing(Store(root, _MAP, Retention.chosen(Settings().store))) as store:
        whole = _checkpoint(mapper, store)
        parts: list[_Cost] = []
        for scan in made.scans[_SCANS : _SCANS + _CHECKPOINTS]:
            mapper.ingest(scan.points, scan.world_from_sensor)
            for _ in range(20):
                mapper.train()
            parts.append(_checkpoint(mapper, store))
    # Copies of one region make the map: each is a sixteenth of its bytes.
    share = 1 / _REGIONS
    bytes_share = statistics.median(part.bytes for part in parts) / whole.bytes
    time_share = statistics.median(part.seconds for part in parts) / whole.seconds
    return [
        Figure("complete checkpoint of 16 regions", whole.bytes / 1e6, "MB"),
        Figure("complete checkpoint of 16 regions, time", whole.seconds, "s"),
        Figure("changed share of the map", 100 * share, "%"),
        Figure("checkpoint's bytes against that share", bytes_share / share, "", at_most=2),
        Figure("checkpoint's time against that share", time_share / share, "", at_most=2),
    ]


@dataclass(frozen=True)
class _Cost:
    """What a checkpoint cost."""

    bytes: int
    seconds: float


def _checkpoint(mapper: Mapper, store: Store) -> _Cost:
    started = time.perf_counter()
    info = store.write(mapper.changes_since(store.base_epoch))
    return _Cost(info.bytes, time.perf_counter() - started)


def _latencies(record: MapRecord, made: BenchStreet, root: Path) -> list[Figure]:
    """Replies while the robot drives on in one region, without and with checkpoints."""
    folder = root / _MAP
    folder.mkdir(parents=True)
    write_map(record, folder / checkpoint_name(record.epoch, complete=True))
    asked = root / "points.npy"
    np.save(asked, np.random.default_rng(0).permutation(made.probes.near)[:_ASKED])
    options = ServerOptions(free_endpoint(), _MAP, root, root / "server.log")
    with (
        DemoServer(options) as server,
        connect(server.endpoint, _MAP, timeout_s=60.0) as client,
        ThreadPoolExecutor(1) as beside,
    ):
        quiet = _drive_on(client, server.endpoint, made, asked, None)
        busy = _drive_on(client, server.endpoint, made, asked, beside)
        last = client.checkpoint()
    name = "1,000 points with gradient, 16 regions, streaming"
    return [
        Figure(f"{name}, 99 %", quiet.latency_p99_ms, "ms"),
        Figure(f"{name}, longest of {quiet.queries}", quiet.latency_max_ms, "ms"),
        Figure(f"{name} and checkpoints, 99 %", busy.latency_p99_ms, "ms"),
        Figure(
            f"{name} and checkpoints, longest of {busy.queries}",
            busy.latency_max_ms,
            "ms",
            at_most=15,
        ),
        Figure("errors meanwhile", quiet.errors + busy.errors, "", at_most=0),
        Figure("size of such a checkpoint", last.bytes / 1e6, "MB"),
    ]


def _drive_on(
    client: Client,
    endpoint: str,
    made: BenchStreet,
    asked: Path,
    checkpoints: Executor | None,
) -> ProbeReport:
    """Publish scans as a lidar does while another process asks."""

    def published(number: int) -> None:
        if checkpoints is not None and number % _EVERY_SCANS == 0:
            checkpoints.submit(client.checkpoint)

    with Probe(endpoint, _MAP, asked, question="gradient") as probe:
        stream(client, made.scans, published=published)
        return probe.finish()
