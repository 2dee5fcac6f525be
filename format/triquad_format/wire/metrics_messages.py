"""The messages in which a server reports how it is doing, in figures.

Counts, sums and times only grow while a server runs: the difference of two answers is for the
seconds between them. ``docs/wire-protocol.md`` says more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from triquad_format.wire import keys
from triquad_format.wire.bounds import MAX_COUNT, rows_of, within
from triquad_format.wire.codec import Message, Request
from triquad_format.wire.messages import Count, Duration, Epoch, Integers, Name
from triquad_format.wire.packing import ArraySpec

Seconds = Annotated[NDArray[np.float64], ArraySpec("<f8", (None,))]


@dataclass(frozen=True)
class TimeHistogram(Message):
    """A histogram of times, as counts in the buckets of ``ServerMetrics.bounds_s``."""

    # [B + 1] of each bucket; the last one is of what took longer than all bounds
    counts: Annotated[Integers, within(0, MAX_COUNT), rows_of("bounds_s", more=1)]
    sum_s: Duration

    @property
    def count(self) -> int:
        """The number of things that were timed."""
        return int(self.counts.sum())


@dataclass(frozen=True)
class OperationMetrics(Message):
    """The requests of one operation, since the server started."""

    answers: TimeHistogram  # what was answered: from arrival until the reply was sent
    waits: TimeHistogram  # what was begun with: from arrival until a worker took it
    refused: dict[Name, Count]  # by error code
    pending: Count  # that arrived and are not replied to yet
    received_bytes: Count  # of requests
    sent_bytes: Count  # of answers

    @property
    def answered(self) -> int:
        """The number of requests that were answered."""
        return self.answers.count


@dataclass(frozen=True)
class QueueMetrics(Message):
    """The items that wait in a queue now."""

    waiting: Count
    limit: Count


@dataclass(frozen=True)
class SourceMetrics(Message):
    """The scans of one source, of all its sessions that are remembered."""

    sessions: Count
    taken: Count
    refused: Count
    lost: Count  # never arrived, or pushed out of the full queue
    age_s: Duration  # since anything was heard of it


@dataclass(frozen=True)
class CheckpointMetrics(Message):
    """Checkpoints since the server started."""

    written: Count
    failed: Count
    last_duration_s: Duration | None  # None before any was written
    age_s: Duration | None  # since the last one was written, by this server
    late_s: Duration = 0.0  # for which more is unsaved than there may be: two periods


@dataclass(frozen=True)
class ServerMetrics(Message):
    """Answer to :class:`MetricsRequest`."""

    server: Name  # a name of this server process: all counts begin at zero with it
    uptime_s: Duration
    problem: str | None  # why the server does not do what it should; None: it does
    epoch: Epoch
    epoch_age_s: Duration  # since the newest epoch was published
    epochs_kept: Count  # that can be asked for by number, pinned ones included
    epochs_pinned: Count  # older ones that stay because they were asked for by number
    # [B] upper bounds of the buckets of all histograms, increasing
    bounds_s: Annotated[Seconds, within(0)]
    operations: dict[Name, OperationMetrics]  # by name, such as "query/sdf"
    queues: dict[Name, QueueMetrics]
    sources: dict[Name, SourceMetrics]  # by name
    scan_bytes_received: Count
    resident_bytes: Count  # memory of the whole process
    mapper_s: dict[Name, Duration]  # how the mapper's thread spent its time, by activity
    checkpoints: CheckpointMetrics
    sessions: dict[Name, Name]  # Zenoh sessions that are connected, by id: client, peer or router
    samples_trained: Count = 0  # by this process; the status counts those of the map

    def __repr__(self) -> str:
        told = f"{len(self.operations)} operations, {len(self.sources)} sources"
        return f"ServerMetrics(up {self.uptime_s:.0f} s, {told}; epoch {self.epoch})"

    def answer_time_s(
        self, operation: str, quantile: float, since: ServerMetrics | None = None
    ) -> float | None:
        """Return the time within which a share of an operation's requests was answered, seconds.

        Args:
            operation: its name, such as ``"query/sdf"``.
            quantile: the share, in [0, 1]: 0.5 for the median.
            since: an earlier answer, to count from there on; one of another server is left out.

        Returns:
            A value interpolated within its bucket; infinity beyond the last bound, ``None`` where
            nothing was answered.
        """
        asked = self.operations.get(operation)
        if asked is None:
            return None
        counts = asked.answers.counts
        if since is not None and since.server == self.server and operation in since.operations:
            counts = counts - since.operations[operation].answers.counts
        return _quantile(self.bounds_s, counts, quantile)


def _quantile(bounds: NDArray[np.float64], counts: NDArray[np.int64], share: float) -> float | None:
    reached = np.cumsum(counts)
    total = int(reached[-1])
    if total == 0:
        return None
    wanted = share * total
    bucket = int(np.searchsorted(reached, max(wanted, 1e-9)))
    if bucket >= len(bounds):
        return math.inf
    low = bounds[bucket - 1] if bucket else 0.0
    within = (wanted - (reached[bucket] - counts[bucket])) / counts[bucket]
    # Rounding must not take it beyond its bucket.
    return float(min(low + within * (bounds[bucket] - low), bounds[bucket]))


@dataclass(frozen=True)
class MetricsRequest(Request[ServerMetrics], operation=keys.METRICS):
    """Ask how the server is doing, in figures."""
