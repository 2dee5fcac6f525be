"""Looking at a server again and again, also while it is gone."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

from triquad_client import BadReplyError, Client, NoReplyError
from triquad_format.errors import TriquadError
from triquad_format.wire.metrics_messages import ServerMetrics

from triquad_tools.top.interval import Interval, Sample, interval

_NO_METRICS = "this server tells no latencies, queues, memory by part and clients: it is older"


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
    """Looks at a server, and remembers what it saw last."""

    def __init__(self, client: Client, period_s: float) -> None:
        """Look every ``period_s``."""
        self._client = client
        self._period_s = period_s
        self._last: Sample | None = None

    def look(self) -> Interval:
        """What happened since the last look.

        Raises:
            TriquadError: the server does not answer.
        """
        sample = self._sample()
        seen = interval(self._last, sample)
        self._last = sample
        return seen

    def looks(self) -> Iterator[Interval | Silence]:
        """A look in each period, for ever.

        A look that takes longer than a period is followed by the next at once.
        """
        due_s = time.monotonic()
        silence: Silence | None = None
        while True:
            began_s = time.monotonic()
            try:
                seen, silence = self.look(), None
            except TriquadError as error:
                silence = Silence(silence.since_s if silence else began_s, str(error))
            yield silence or seen
            now_s = time.monotonic()
            due_s = max(due_s + self._period_s, now_s)
            time.sleep(due_s - now_s)

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
