"""What happened between two samples of a server: records in, rates and quantiles out."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from triquad_format.wire.messages import ServerStatus
from triquad_format.wire.metrics_messages import ServerMetrics, SourceMetrics


@dataclass(frozen=True)
class Sample:
    """What a server said of itself at one time."""

    stamp_ns: int  # since 1970, of the clock here
    status: ServerStatus
    metrics: ServerMetrics | None
    metrics_missing: str | None = None  # why there are none


@dataclass(frozen=True)
class Rates:
    """What happened in an interval, a second of it, by the status."""

    scans_taken: float
    scans_lost: dict[str, float]  # by source
    scans_dropped: dict[str, float]  # by reason
    points_dropped: dict[str, float]  # by reason
    requests_refused: dict[str, float]  # by error code
    samples_trained: float
    epochs: float


@dataclass(frozen=True)
class SourceRates:
    """The scans of one source, a second."""

    taken: float
    refused: float
    lost: float


@dataclass(frozen=True)
class OperationRates:
    """The requests of one operation, a second, and how long those took that were answered."""

    answered: float
    refused: dict[str, float]  # by error code
    received_bytes: float
    sent_bytes: float
    p50_s: float | None  # None: nothing was answered
    p99_s: float | None


@dataclass(frozen=True)
class Traffic:
    """What happened in an interval, a second of it, by the metrics."""

    scan_bytes_received: float
    sources: dict[str, SourceRates]
    operations: dict[str, OperationRates]
    mapper_share: dict[str, float]  # of the time, by what the mapper's thread did

    @property
    def requests_answered(self) -> float:
        """Of all operations."""
        return sum(operation.answered for operation in self.operations.values())

    @property
    def received_bytes(self) -> float:
        """Of the requests of all operations."""
        return sum(operation.received_bytes for operation in self.operations.values())

    @property
    def sent_bytes(self) -> float:
        """Of the answers of all operations."""
        return sum(operation.sent_bytes for operation in self.operations.values())


@dataclass(frozen=True)
class Interval:
    """A sample, and what happened since the one before, where that is of the same server."""

    sample: Sample
    seconds: float | None  # since the sample before
    rates: Rates | None
    traffic: Traffic | None
    restarted: bool  # since the sample before


def interval(before: Sample | None, after: Sample) -> Interval:
    """What happened between two samples. A restarted server has counted anew: it has no rates.

    The time between them is the server's own: samples may have been under way for long.
    """
    if before is None:
        return Interval(after, None, None, None, restarted=False)
    if before.status.server != after.status.server:
        return Interval(after, None, None, None, restarted=True)
    seconds = _seconds(before.status.uptime_s, after.status.uptime_s)
    rates = None if seconds is None else _rates(before.status, after.status, seconds)
    traffic = _traffic_between(before.metrics, after.metrics)
    return Interval(after, seconds, rates, traffic, restarted=False)


def _seconds(before_s: float, after_s: float) -> float | None:
    seconds = after_s - before_s
    return seconds if 0.0 < seconds < math.inf else None


def _rates(before: ServerStatus, after: ServerStatus, seconds: float) -> Rates:
    return Rates(
        scans_taken=_per_s(before.scans_taken, after.scans_taken, seconds),
        scans_lost=_each_per_s(before.scans_lost, after.scans_lost, seconds),
        scans_dropped=_each_per_s(before.scans_dropped, after.scans_dropped, seconds),
        points_dropped=_each_per_s(before.points_dropped, after.points_dropped, seconds),
        requests_refused=_each_per_s(before.requests_refused, after.requests_refused, seconds),
        samples_trained=_per_s(before.samples_trained, after.samples_trained, seconds),
        epochs=_per_s(before.epoch, after.epoch, seconds),
    )


def _traffic_between(before: ServerMetrics | None, after: ServerMetrics | None) -> Traffic | None:
    if before is None or after is None or before.server != after.server:
        return None
    seconds = _seconds(before.uptime_s, after.uptime_s)
    if seconds is None or len(before.bounds_s) != len(after.bounds_s):
        return None
    return Traffic(
        _per_s(before.scan_bytes_received, after.scan_bytes_received, seconds),
        sources={
            name: _source_rates(before.sources.get(name), source, seconds)
            for name, source in after.sources.items()
        },
        operations={name: _operation_rates(name, before, after) for name in after.operations},
        mapper_share=_each_per_s(before.mapper_s, after.mapper_s, seconds),
    )


def _source_rates(
    before: SourceMetrics | None, after: SourceMetrics, seconds: float
) -> SourceRates:
    return SourceRates(
        taken=_per_s(before.taken if before else 0, after.taken, seconds),
        refused=_per_s(before.refused if before else 0, after.refused, seconds),
        lost=_per_s(before.lost if before else 0, after.lost, seconds),
    )


def _operation_rates(name: str, before: ServerMetrics, after: ServerMetrics) -> OperationRates:
    was, now = before.operations.get(name), after.operations[name]
    seconds = after.uptime_s - before.uptime_s
    grown = was is None or bool(np.all(now.answers.counts >= was.answers.counts))
    return OperationRates(
        answered=_per_s(was.answered if was else 0, now.answered, seconds),
        refused=_each_per_s(was.refused if was else {}, now.refused, seconds),
        received_bytes=_per_s(was.received_bytes if was else 0, now.received_bytes, seconds),
        sent_bytes=_per_s(was.sent_bytes if was else 0, now.sent_bytes, seconds),
        p50_s=after.answer_time_s(name, 0.5, since=before) if grown else None,
        p99_s=after.answer_time_s(name, 0.99, since=before) if grown else None,
    )


def _per_s(before: float, after: float, seconds: float) -> float:
    """A counter's rate: never below 0, for servers forget what concerns sources long silent."""
    return max(0.0, after - before) / seconds


def _each_per_s(
    before: Mapping[str, float], after: Mapping[str, float], seconds: float
) -> dict[str, float]:
    return {name: _per_s(before.get(name, 0.0), count, seconds) for name, count in after.items()}
