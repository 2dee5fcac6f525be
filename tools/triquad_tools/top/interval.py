"""The rates between two samples of a server, each a pair of messages."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from triquad_format.wire.messages import ServerStatus
from triquad_format.wire.metrics_messages import ServerMetrics


@dataclass(frozen=True)
class Sample:
    """The state that a server reported at one time."""

    status: ServerStatus
    metrics: ServerMetrics

    def each(self, field: str) -> dict[str, Any]:
        """Return a field of all operations or sources, such as ``operations.answered``."""
        records, _, name = field.partition(".")
        return {key: getattr(one, name) for key, one in getattr(self.metrics, records).items()}

    @property
    def refused(self) -> dict[str, int]:
        """Requests that were refused, by operation and error code, such as ``query/sdf: busy``."""
        refused = self.each("operations.refused").items()
        return {f"{name}: {code}": n for name, codes in refused for code, n in codes.items()}


@dataclass(frozen=True)
class Rates:
    """Rates of an interval, per second of the server's clock."""

    seconds: float  # length of the interval
    epochs: float
    samples_trained: float
    scans_taken: float
    scan_bytes_received: float
    scans_dropped: dict[str, float]  # by reason
    points_dropped: dict[str, float]  # by reason
    source_taken: dict[str, float]  # scans by source
    source_lost: dict[str, float]  # scans by source
    answered: dict[str, float]  # requests by operation
    refused: dict[str, float]  # requests, as Sample.refused
    p50_s: dict[str, float | None]  # of answered requests, by operation; None: there were none,
    p99_s: dict[str, float | None]  # infinite: longer than the server measures
    mapper_share: dict[str, float]  # of the time, by what the mapper's thread did


def rates(before: Sample | None, after: Sample) -> Rates | None:
    """Return the rates between two samples, ``None`` where they are not of the same server.

    A restarted server counts from zero again, so that it has no rates until its second sample.
    """
    if before is None or before.status.server != after.status.server:
        return None
    old, new, was, now = before.status, after.status, before.metrics, after.metrics
    seconds = now.uptime_s - was.uptime_s
    if not 0.0 < seconds < math.inf:
        return None

    def per_s(earlier: float, later: float) -> float:
        return max(0.0, later - earlier) / seconds  # counts of sources that are removed shrink

    def each(earlier: Mapping[str, float], later: Mapping[str, float]) -> dict[str, float]:
        return {name: per_s(earlier.get(name, 0.0), count) for name, count in later.items()}

    return Rates(
        seconds=seconds,
        epochs=per_s(old.epoch, new.epoch),
        samples_trained=per_s(old.samples_trained, new.samples_trained),
        scans_taken=per_s(old.scans_taken, new.scans_taken),
        scan_bytes_received=per_s(was.scan_bytes_received, now.scan_bytes_received),
        scans_dropped=each(old.scans_dropped, new.scans_dropped),
        points_dropped=each(old.points_dropped, new.points_dropped),
        source_taken=each(before.each("sources.taken"), after.each("sources.taken")),
        source_lost=each(before.each("sources.lost"), after.each("sources.lost")),
        answered=each(before.each("operations.answered"), after.each("operations.answered")),
        refused=each(before.refused, after.refused),
        p50_s={name: now.answer_time_s(name, 0.5, since=was) for name in now.operations},
        p99_s={name: now.answer_time_s(name, 0.99, since=was) for name in now.operations},
        mapper_share=each(was.mapper_s, now.mapper_s),
    )
