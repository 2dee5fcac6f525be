"""What a server could say of itself, for tests of what is shown of it."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.wire.messages import CheckpointInfo
from triquad_format.wire.metrics_messages import (
    CheckpointMetrics,
    OperationMetrics,
    QueueMetrics,
    ServerMetrics,
    SourceMetrics,
    TimeHistogram,
)
from triquad_format.wire.status_messages import KeptScans, ServerStatus
from triquad_tools.work.top import Sample

BOUNDS_S = np.array([0.001, 0.01, 0.1, 1.0, 10.0])

CHECKPOINT = CheckpointInfo(
    path="/maps/default/1200.triquad",
    bytes=2_500_000,
    epoch=1200,
    sha256="ab" * 32,
    stamp_ns=10**18,
)

STATUS = ServerStatus(
    map_name="default",
    server="first",
    version="0.2.0",
    device="cpu",
    epoch=1234,
    settled=False,
    scans_taken=12_345,
    scans_dropped={},
    scans_lost={"roof": 0, "camera": 12},
    scans_waiting=3,
    points_dropped={"too_near": 5000},
    requests_refused={},
    samples_trained=1_240_000_000,
    rays_kept=1_450_000,
    loss=0.0123,
    regions=1,
    vertices=211_000,
    parameters=1_900_000,
    memory_bytes=612_000_000,
    uptime_s=11_520.0,
    last_checkpoint=CHECKPOINT,
    store_error=None,
    samples_left=3_100_000,
    kept_scans=KeptScans(bytes=412_000_000, max_bytes=10**9, since_ns=10**18 + 5 * 10**8),
)


def histogram(times_s: ArrayLike = ()) -> TimeHistogram:
    """The histogram of some times."""
    times = np.asarray(times_s, np.float64)
    counts = np.bincount(np.searchsorted(BOUNDS_S, times), minlength=len(BOUNDS_S) + 1)
    return TimeHistogram(counts.astype(np.int64), float(times.sum()))


def operation(times_s: ArrayLike = (), **changes: Any) -> OperationMetrics:
    """Requests that were answered in these times."""
    answers = histogram(times_s)
    sizes = {"received_bytes": 1000 * answers.count, "sent_bytes": 2000 * answers.count}
    values = {"refused": {}, "pending": 0, **sizes, **changes}
    return OperationMetrics(answers, histogram(), **values)


METRICS = ServerMetrics(
    server="first",
    uptime_s=11_520.0,
    problem=None,
    epoch=1234,
    epoch_age_s=0.4,
    epochs_kept=4,
    epochs_pinned=0,
    bounds_s=BOUNDS_S,
    operations={"query/distance": operation([0.004] * 99), "query/sdf": operation()},
    queues={"scans": QueueMetrics(3, 10)},
    sources={
        "roof": SourceMetrics(1, 12_000, 0, 0, 0.1),
        "camera": SourceMetrics(1, 345, 0, 12, 0.2),
    },
    scan_bytes_received=8_000_000_000,
    resident_bytes=612_000_000,
    mapper_s={"train": 8000.0, "idle": 3000.0},
    checkpoints=CheckpointMetrics(14, 0, 0.31, 32.0),
    sessions={"aa": "client", "bb": "client"},
)


def later(seconds: float, status: Any = None, metrics: Any = None) -> Sample:
    """A sample ``seconds`` after ``STATUS`` and ``METRICS``, with these changes."""
    uptime_s = STATUS.uptime_s + seconds
    return Sample(
        replace(STATUS, uptime_s=uptime_s, **(status or {})),
        replace(METRICS, uptime_s=uptime_s, **(metrics or {})),
    )
