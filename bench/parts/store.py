"""Checkpoints: a map of 16 regions while the robot drives on in one."""

import dataclasses
import statistics
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.records.region import MapRecord
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_server.store.store import Store

from bench.clients.served import MAP, latency_figures, served, stream_beside_planner
from bench.figures import Figure
from bench.street_scores import DrivenStreet

_REGIONS = 16
_SCANS = 40  # that made the map
_SAMPLES = 6_000_000
_CHECKPOINTS = 6
_EVERY_SCANS = 50  # five seconds


def measure_store(made: DrivenStreet) -> list[Figure]:
    """Return figures of checkpoints."""
    record = _row(made)
    return _costs(record, made) + _latencies(record, made)


def _row(made: DrivenStreet) -> MapRecord:
    """Return a street's region, settled, 16 times in a row."""
    settings = Settings()
    mapper = Mapper(MAP, settings, "cpu")
    for scan in made.scans[:_SCANS]:
        mapper.ingest(scan.points, scan.world_from_sensor)
    while mapper.samples_trained < _SAMPLES:
        mapper.train()
    record = mapper.snapshot_since(None).record()
    (region,) = record.regions
    training = region.training
    assert training is not None
    settled = dataclasses.replace(region, training=dataclasses.replace(training, budget_samples=0))
    return dataclasses.replace(
        record,
        regions=tuple(
            dataclasses.replace(settled, index=(number, 0, 0)) for number in range(_REGIONS)
        ),
    )


def _costs(record: MapRecord, made: DrivenStreet) -> list[Figure]:
    """Return bytes and time of a first checkpoint, and of those after driving in one region."""
    mapper = Mapper(MAP, Settings(), "cpu", record=record)
    with (
        tempfile.TemporaryDirectory(prefix="triquad-bench-") as root,
        closing(Store(Path(root), MAP, Settings().store)) as store,
    ):
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
        Figure("first checkpoint of 16 regions", whole.bytes / 1e6, "MB"),
        Figure("first checkpoint of 16 regions, time", whole.seconds, "s"),
        Figure("changed share of the map", 100 * share, "%"),
        Figure("checkpoint's bytes against that share", bytes_share / share, "", at_most=2),
        Figure("checkpoint's time against that share", time_share / share, "", at_most=2),
    ]


@dataclass(frozen=True)
class _Cost:
    """The cost of a checkpoint."""

    bytes: int  # growth of the store
    seconds: float


def _checkpoint(mapper: Mapper, store: Store) -> _Cost:
    before = _stored_bytes(store.folder)
    started = time.perf_counter()
    snapshot = mapper.snapshot_since(store.base_epoch)
    store.write(snapshot.epoch.record(()), snapshot.records(), snapshot.facts)
    seconds = time.perf_counter() - started
    return _Cost(_stored_bytes(store.folder) - before, seconds)


def _stored_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _latencies(record: MapRecord, made: DrivenStreet) -> list[Figure]:
    """Return latencies while the robot drives on in one region, without and with checkpoints."""
    arguments = ["--set", "store.period_s=0"]
    with served(record, arguments) as server, ThreadPoolExecutor(1) as beside:
        server.client.checkpoint()

        def published(number: int) -> None:
            if number % _EVERY_SCANS == 0:
                beside.submit(server.client.checkpoint)

        quiet = stream_beside_planner(server, made)
        busy = stream_beside_planner(server, made, published)
        last = server.client.checkpoint()
    name = "1,000 points with gradient, 16 regions, streaming"
    return [
        *latency_figures(name, quiet),
        *latency_figures(f"{name} and checkpoints", busy),
        Figure(
            "99 % of these, of that without",
            busy.latency_p99_ms / quiet.latency_p99_ms,
            "",
            at_most=1.5,
        ),
        Figure("size of such a checkpoint", last.bytes / 1e6, "MB"),
    ]
