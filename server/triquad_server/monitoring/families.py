"""The metrics that Prometheus is told: each with its name, kind, labels, and where it comes from.

``docs/metrics.md`` lists them. Names from the network stand in the label ``source`` alone, of which
there are a bounded number; all other values of labels are words of the program.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from triquad_format.wire.messages import ServerStatus
from triquad_format.wire.metrics_messages import OperationMetrics, ServerMetrics, TimeHistogram


class Kind(Enum):
    """How the values of a metric behave."""

    COUNTER = "counter"  # it only grows, and begins anew with the process
    GAUGE = "gauge"
    HISTOGRAM = "histogram"


class Figures(NamedTuple):
    """All that is known of a server at one time."""

    status: ServerStatus
    metrics: ServerMetrics


class Value(NamedTuple):
    """One value of a metric, of certain labels."""

    labels: tuple[str, ...]
    value: float | TimeHistogram


Read = Callable[[Figures], Iterator[Value]]


@dataclass(frozen=True)
class Family:
    """A metric, with its values of all labels."""

    name: str
    kind: Kind
    meaning: str
    labels: tuple[str, ...]
    read: Read


def _single(read: Callable[[Figures], float | None]) -> Read:
    """The only value of a metric without labels; none where ``read`` gives ``None``."""

    def values(figures: Figures) -> Iterator[Value]:
        value = read(figures)
        if value is not None:
            yield Value((), value)

    return values


def _each(read: Callable[[Figures], Mapping[str, float]]) -> Read:
    """The values of a metric with one label."""

    def values(figures: Figures) -> Iterator[Value]:
        for label, value in read(figures).items():
            yield Value((label,), value)

    return values


def _operations(read: Callable[[OperationMetrics], float | TimeHistogram]) -> Read:
    """A value of each operation that was ever asked for."""

    def values(figures: Figures) -> Iterator[Value]:
        for name, operation in figures.metrics.operations.items():
            if operation.received_bytes:
                yield Value((name,), read(operation))

    return values


def _refused(figures: Figures) -> Iterator[Value]:
    for name, operation in figures.metrics.operations.items():
        for code, count in operation.refused.items():
            yield Value((name, code), count)


def _source_scans(figures: Figures) -> Iterator[Value]:
    for name, source in figures.metrics.sources.items():
        yield Value((name, "taken"), source.taken)
        yield Value((name, "refused"), source.refused)
        yield Value((name, "lost"), source.lost)


def _information(figures: Figures) -> Iterator[Value]:
    status = figures.status
    yield Value((status.map_name, status.server, status.version, status.device), 1)


def _counter(name: str, meaning: str, read: Read, *labels: str) -> Family:
    return Family(name, Kind.COUNTER, meaning, labels, read)


def _gauge(name: str, meaning: str, read: Read, *labels: str) -> Family:
    return Family(name, Kind.GAUGE, meaning, labels, read)


def _histogram(name: str, meaning: str, read: Read, *labels: str) -> Family:
    return Family(name, Kind.HISTOGRAM, meaning, labels, read)


_SERVER = (
    _gauge(
        "triquad_server_info",
        "1; the labels name the map, this process, its release and what it computes on",
        _information,
        *("map", "server", "version", "device"),
    ),
    _gauge(
        "triquad_healthy",
        "1 while the server does all that it should, as /healthz says; else 0",
        _single(lambda f: float(f.metrics.problem is None)),
    ),
    _gauge(
        "triquad_uptime_seconds",
        "Time since the server began to serve",
        _single(lambda f: f.metrics.uptime_s),
    ),
    _gauge(
        "triquad_sessions",
        "Zenoh sessions that are connected, by kind: client, peer or router",
        _each(lambda f: Counter(f.metrics.sessions.values())),
        "kind",
    ),
)

_SCANS = (
    _counter(
        "triquad_scans_received_total",
        "Scans that arrived over Zenoh, whatever became of them",
        _single(lambda f: f.metrics.scans_received),
    ),
    _counter(
        "triquad_scans_received_bytes_total",
        "Bytes of these",
        _single(lambda f: f.metrics.scan_bytes_received),
    ),
    _counter(
        "triquad_scans_taken_total",
        "Scans that were taken in",
        _single(lambda f: f.status.scans_taken),
    ),
    _counter(
        "triquad_scans_dropped_total",
        "Scans that were refused, by reason",
        _each(lambda f: f.status.scans_dropped),
        "reason",
    ),
    _counter(
        "triquad_source_scans_total",
        "Scans of each source by outcome: taken, refused or lost; of more than 64 sources, "
        "those heard of longest ago are together, as *",
        _source_scans,
        *("source", "outcome"),
    ),
    _gauge(
        "triquad_source_age_seconds",
        "Time since a scan of each source arrived",
        _each(lambda f: {name: one.age_s for name, one in f.metrics.sources.items()}),
        "source",
    ),
    _counter(
        "triquad_points_dropped_total",
        "Points and rays of taken scans that are not used, by reason",
        _each(lambda f: f.status.points_dropped),
        "reason",
    ),
)

_REQUESTS = (
    _histogram(
        "triquad_request_duration_seconds",
        "Time of answered requests, from arrival until the reply was sent, by operation",
        _operations(lambda operation: operation.answers),
        "operation",
    ),
    _histogram(
        "triquad_request_wait_seconds",
        "Time of requests from arrival until a worker took them, by operation",
        _operations(lambda operation: operation.waits),
        "operation",
    ),
    _counter(
        "triquad_requests_refused_total",
        "Requests that were refused, by operation and error code",
        _refused,
        *("operation", "code"),
    ),
    _gauge(
        "triquad_requests_pending",
        "Requests without a reply yet, by operation",
        _operations(lambda operation: operation.pending),
        "operation",
    ),
    _counter(
        "triquad_request_received_bytes_total",
        "Bytes of requests, by operation",
        _operations(lambda operation: operation.received_bytes),
        "operation",
    ),
    _counter(
        "triquad_request_sent_bytes_total",
        "Bytes of answers, by operation",
        _operations(lambda operation: operation.sent_bytes),
        "operation",
    ),
    _gauge(
        "triquad_queue_waiting",
        "What waits in each queue",
        _each(lambda f: {name: queue.waiting for name, queue in f.metrics.queues.items()}),
        "queue",
    ),
    _gauge(
        "triquad_queue_limit",
        "What may wait in each queue: of scans, the oldest is lost beyond; requests are refused",
        _each(lambda f: {name: queue.limit for name, queue in f.metrics.queues.items()}),
        "queue",
    ),
)

_MAP = (
    _gauge(
        "triquad_epoch", "Number of the newest epoch", _single(lambda f: float(f.metrics.epoch))
    ),
    _gauge(
        "triquad_epoch_age_seconds",
        "Time since the newest epoch was published; grows while nothing changes",
        _single(lambda f: f.metrics.epoch_age_s),
    ),
    _gauge(
        "triquad_epochs_kept",
        "Epochs that can be asked for by number",
        _single(lambda f: f.metrics.epochs_kept),
    ),
    _gauge(
        "triquad_epochs_pinned",
        "Those of them that stay because they were asked for by number",
        _single(lambda f: f.metrics.epochs_pinned),
    ),
    _gauge("triquad_regions", "Regions of the map", _single(lambda f: f.status.regions)),
    _gauge("triquad_vertices", "Quadtree vertices", _single(lambda f: f.status.vertices)),
    _gauge("triquad_parameters", "Learnable numbers", _single(lambda f: f.status.parameters)),
    _gauge(
        "triquad_rays_kept",
        "Rays in the replay pools",
        _single(lambda f: f.status.rays_kept),
    ),
)

_TRAINING = (
    _counter(
        "triquad_samples_trained_total",
        "Training samples",
        _single(lambda f: f.status.samples_trained),
    ),
    _gauge(
        "triquad_samples_left",
        "Training samples until nothing is left to learn",
        _single(lambda f: f.status.samples_left),
    ),
    _gauge(
        "triquad_settled",
        "1 where nothing is left to learn and the newest epoch shows all; else 0",
        _single(lambda f: float(f.status.settled)),
    ),
    _gauge("triquad_loss", "Recent training loss", _single(lambda f: f.status.loss)),
    _counter(
        "triquad_mapper_seconds_total",
        "How the thread that maps spent its time: scans, training, giving_way (to queries), "
        "publishing, commands (such as what a checkpoint needs) or idle",
        _each(lambda f: f.metrics.mapper_s),
        "activity",
    ),
)

_MEMORY = (
    _gauge(
        "triquad_resident_memory_bytes",
        "Memory of the process, with its libraries",
        _single(lambda f: f.metrics.resident_bytes),
    ),
    _gauge(
        "triquad_memory_bytes",
        "Memory of arrays, by part, with the room that they have to grow",
        _each(lambda f: f.metrics.memory_bytes),
        "part",
    ),
)


def _checkpoints(figures: Figures) -> Mapping[str, float]:
    checkpoints = figures.metrics.checkpoints
    return {"written": checkpoints.written, "failed": checkpoints.failed}


def _last_checkpoint_bytes(figures: Figures) -> float | None:
    last = figures.status.last_checkpoint
    return None if last is None else last.bytes


_STORE = (
    _counter(
        "triquad_checkpoints_total",
        "Checkpoints by outcome: written or failed",
        _each(_checkpoints),
        "outcome",
    ),
    _gauge(
        "triquad_checkpoint_duration_seconds",
        "How long writing the last checkpoint took",
        _single(lambda f: f.metrics.checkpoints.last_duration_s),
    ),
    _gauge(
        "triquad_checkpoint_age_seconds",
        "Time since the last checkpoint of this process was written",
        _single(lambda f: f.metrics.checkpoints.age_s),
    ),
    _gauge(
        "triquad_checkpoint_bytes",
        "Size of the last checkpoint, which holds what changed since the one before",
        _single(_last_checkpoint_bytes),
    ),
)

FAMILIES = (*_SERVER, *_SCANS, *_REQUESTS, *_MAP, *_TRAINING, *_MEMORY, *_STORE)
