"""Observing a server again and again, also while it is gone."""

import time
from dataclasses import dataclass

from triquad_client import BadReplyError, Client, NoReplyError
from triquad_format.errors import TriquadError
from triquad_format.wire.metrics_messages import ServerMetrics

from triquad_tools.top.interval import Interval, Sample, interval

_NO_METRICS = (
    "no latencies, queues, memory by part and clients are told: the server is older than this "
    "question, or access control forbids it"
)


@dataclass(frozen=True)
class Target:
    """Which map of which server is watched."""

    endpoint: str
    map_name: str


@dataclass(frozen=True)
class Silence:
    """The server does not answer."""

    since_s: float  # monotonic
    reason: str


class Watch:
    """Observes a server once in a while, and remembers what it saw last."""

    def __init__(self, client: Client, period_s: float) -> None:
        """It is to be observed every ``period_s``, the first time at once."""
        self._client = client
        self._period_s = period_s
        self._due_s = time.monotonic()
        self._last: Sample | None = None
        self._silent_since_s: float | None = None

    @property
    def due_in_s(self) -> float:
        """Time until it is to be observed next; 0 where that took longer than a period."""
        return max(0.0, self._due_s - time.monotonic())

    def observe(self) -> Interval:
        """What happened since the last time that was answered.

        Raises:
            TriquadError: the server does not answer.
        """
        began_s = time.monotonic()
        self._due_s = max(self._due_s, began_s) + self._period_s
        try:
            sample = self._sample()
        except TriquadError:
            self._silent_since_s = self._silent_since_s or began_s
            raise
        seen = interval(self._last, sample)
        self._last, self._silent_since_s = sample, None
        return seen

    def observe_again(self) -> Interval | Silence:
        """As :meth:`observe`, but a server that does not answer is waited for."""
        try:
            return self.observe()
        except TriquadError as error:
            return Silence(self._silent_since_s or 0.0, str(error))

    def _sample(self) -> Sample:
        status = self._client.status()
        last = self._last
        if last is not None and last.metrics_missing and last.status.server == status.server:
            return Sample(time.time_ns(), status, None, last.metrics_missing)
        try:
            return Sample(time.time_ns(), status, _checked(self._client.metrics()))
        except NoReplyError:
            return Sample(time.time_ns(), status, None, _NO_METRICS)


def _checked(metrics: ServerMetrics) -> ServerMetrics:
    """The metrics, where their histograms have the buckets of which they speak."""
    buckets = len(metrics.bounds_s) + 1
    for name, operation in metrics.operations.items():
        counted = len(operation.answers.counts)
        if counted != buckets or buckets == 1:
            raise BadReplyError(f"{name} counts {counted} buckets of {buckets}: another release?")
    return metrics
