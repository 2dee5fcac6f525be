"""The metrics that Prometheus is told: each with its name, kind, labels, and where it comes from.

``docs/metrics.md`` lists them. Names from the network stand in the label ``source`` alone, of which
there are a bounded number; all other values of labels are words of the program.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping

from triquad_format.wire.metrics_messages import OperationMetrics, TimeHistogram

from triquad_server.monitoring.family import (
    Figures,
    Read,
    Value,
    counter,
    each,
    gauge,
    histogram,
    single,
)


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


_SERVER = (
    gauge(
        "triquad_server_info",
        "1; the labels name the map, this process, its release and what it computes on",
        _information,
        *("map", "server", "version", "device"),
    ),
    gauge(
        "triquad_healthy",
        "1 while the server does all that it should, as /healthz says; else 0",
        single(lambda f: float(f.metrics.problem is None)),
    ),
    gauge(
        "triquad_uptime_seconds",
        "Time since the server began to serve",
        single(lambda f: f.metrics.uptime_s),
    ),
    gauge(
        "triquad_sessions",
        "Zenoh sessions that are connected, by kind: client, peer or router",
        each(lambda f: Counter(f.metrics.sessions.values())),
        "kind",
    ),
)

_SCANS = (
    counter(
        "triquad_scans_received_total",
        "Scans that arrived over Zenoh, whatever became of them",
        single(lambda f: f.metrics.scans_received),
    ),
    counter(
        "triquad_scans_received_bytes_total",
        "Bytes of these",
        single(lambda f: f.metrics.scan_bytes_received),
    ),
    counter(
        "triquad_scans_taken_total",
        "Scans that were taken in",
        single(lambda f: f.metrics.scans_taken),
    ),
    counter(
        "triquad_scans_dropped_total",
        "Scans that were refused, by reason",
        each(lambda f: f.status.scans_dropped),
        "reason",
    ),
    counter(
        "triquad_source_scans_total",
        "Scans of each source by outcome: taken, refused or lost; of more than 64 sources, "
        "those heard of longest ago are together, as *",
        _source_scans,
        *("source", "outcome"),
    ),
    gauge(
        "triquad_source_age_seconds",
        "Time since a scan of each source arrived",
        each(lambda f: {name: one.age_s for name, one in f.metrics.sources.items()}),
        "source",
    ),
    counter(
        "triquad_points_dropped_total",
        "Points and rays of taken scans that are not used, by reason",
        each(lambda f: f.status.points_dropped),
        "reason",
    ),
)

_REQUESTS = (
    histogram(
        "triquad_request_duration_seconds",
        "Time of answered requests, from arrival until the reply was sent, by operation",
        _operations(lambda operation: operation.answers),
        "operation",
    ),
    histogram(
        "triquad_request_wait_seconds",
        "Time of requests from arrival until a worker took them, by operation",
        _operations(lambda operation: operation.waits),
        "operation",
    ),
    counter(
        "triquad_requests_refused_total",
        "Requests that were refused, by operation and error code",
        _refused,
        *("operation", "code"),
    ),
    gauge(
        "triquad_requests_pending",
        "Requests without a reply yet, by operation",
        _operations(lambda operation: operation.pending),
        "operation",
    ),
    counter(
        "triquad_request_received_bytes_total",
        "Bytes of requests, by operation",
        _operations(lambda operation: operation.received_bytes),
        "operation",
    ),
    counter(
        "triquad_request_sent_bytes_total",
        "Bytes of answers, by operation",
        _operations(lambda operation: operation.sent_bytes),
        "operation",
    ),
    gauge(
        "triquad_queue_waiting",
        "What waits in each queue",
        each(lambda f: {name: queue.waiting for name, queue in f.metrics.queues.items()}),
        "queue",
    ),
    gauge(
        "triquad_queue_limit",
        "What may wait in each queue: of scans those of one source, of which the oldest is lost "
        "beyond; requests are refused",
        each(lambda f: {name: queue.limit for name, queue in f.metrics.queues.items()}),
        "queue",
    ),
)

_MAP = (
    gauge("triquad_epoch", "Number of the newest epoch", single(lambda f: float(f.metrics.epoch))),
    gauge(
        "triquad_epoch_age_seconds",
        "Time since the newest epoch was published; grows while nothing changes",
        single(lambda f: f.metrics.epoch_age_s),
    ),
    gauge(
        "triquad_epochs_kept",
        "Epochs that can be asked for by number",
        single(lambda f: f.metrics.epochs_kept),
    ),
    gauge(
        "triquad_epochs_pinned",
        "Those of them that stay because they were asked for by number",
        single(lambda f: f.metrics.epochs_pinned),
    ),
    gauge("triquad_regions", "Regions of the map", single(lambda f: f.status.regions)),
    gauge("triquad_vertices", "Quadtree vertices", single(lambda f: f.status.vertices)),
    gauge("triquad_parameters", "Learnable numbers", single(lambda f: f.status.parameters)),
    gauge(
        "triquad_rays_kept",
        "Rays in the replay pools",
        single(lambda f: f.status.rays_kept),
    ),
    gauge(
        "triquad_replay_share",
        "Of the rays that each place is to keep, the share that memory has room for",
        single(lambda f: f.status.replay_share),
    ),
    counter(
        "triquad_rays_discarded_total",
        "Rays that gave way to others of the same place",
        single(lambda f: f.status.rays_discarded),
    ),
)

_TRAINING = (
    counter(
        "triquad_samples_trained_total",
        "Training samples",
        single(lambda f: f.metrics.samples_trained),
    ),
    gauge(
        "triquad_samples_left",
        "Training samples until nothing is left to learn",
        single(lambda f: f.status.samples_left),
    ),
    counter(
        "triquad_samples_discarded_total",
        "Training samples that are more than the area mapped may owe",
        single(lambda f: f.status.samples_discarded),
    ),
    gauge(
        "triquad_held_out_median_metres",
        "Median of how far from zero the field is where rays end that it is not trained on",
        single(lambda f: f.status.fit.median_m if f.status.fit else None),
    ),
    gauge(
        "triquad_places_repairing",
        "Places that fit such rays worse than they did, and that are being learnt again",
        single(lambda f: f.status.fit.repairing if f.status.fit else None),
    ),
    gauge(
        "triquad_settled",
        "1 where nothing is left to learn and the newest epoch shows all; else 0",
        single(lambda f: float(f.status.settled)),
    ),
    gauge("triquad_loss", "Recent training loss", single(lambda f: f.status.loss)),
    counter(
        "triquad_mapper_seconds_total",
        "How the thread that maps spent its time: scans, training, giving_way (to queries), "
        "publishing, commands (such as what a checkpoint needs) or idle",
        each(lambda f: f.metrics.mapper_s),
        "activity",
    ),
)

_MEMORY = (
    gauge(
        "triquad_map_memory_bytes",
        "Memory of the map with its newest epoch",
        single(lambda f: f.status.map_bytes),
    ),
    gauge(
        "triquad_map_memory_limit_bytes",
        "Beyond this, scans are refused as map_full",
        single(lambda f: f.status.map_max_bytes),
    ),
    gauge(
        "triquad_resident_memory_bytes",
        "Memory of the process, with its libraries",
        single(lambda f: f.metrics.resident_bytes),
    ),
    gauge(
        "triquad_memory_bytes",
        "Memory of arrays, by part, with the room that they have to grow",
        each(lambda f: f.metrics.memory_bytes),
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
    counter(
        "triquad_checkpoints_total",
        "Checkpoints by outcome: written or failed",
        each(_checkpoints),
        "outcome",
    ),
    gauge(
        "triquad_checkpoint_duration_seconds",
        "How long writing the last checkpoint took",
        single(lambda f: f.metrics.checkpoints.last_duration_s),
    ),
    gauge(
        "triquad_checkpoint_age_seconds",
        "Time since the last checkpoint of this process was written",
        single(lambda f: f.metrics.checkpoints.age_s),
    ),
    gauge(
        "triquad_checkpoint_bytes",
        "Size of the last checkpoint, which holds what changed since the one before",
        single(_last_checkpoint_bytes),
    ),
)

FAMILIES = (*_SERVER, *_SCANS, *_REQUESTS, *_MAP, *_TRAINING, *_MEMORY, *_STORE)
