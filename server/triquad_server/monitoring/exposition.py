"""The metrics as Prometheus reads them."""

from collections.abc import Iterator

import numpy as np
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from triquad_format.wire.metrics_messages import Seconds, TimeHistogram

from triquad_server.monitoring.families import FAMILIES
from triquad_server.monitoring.family import Family, Figures, Kind


def exposition(figures: Figures, accept: str) -> tuple[bytes, str]:
    """The metrics as text, and its type; ``accept`` is what the reader's request accepts."""
    try:
        encode, content_type = choose_encoder(accept)
    except (TypeError, ValueError):  # such as a version that is no number
        encode, content_type = choose_encoder("")
    return encode(FiguresCollector(figures)), content_type


class FiguresCollector(Collector):
    """The figures of one time, as metrics."""

    def __init__(self, figures: Figures) -> None:
        self._figures = figures

    def collect(self) -> Iterator[Metric]:
        """All metrics that there are."""
        for family in FAMILIES:
            if family.kind is Kind.HISTOGRAM:
                yield _histogram(family, self._figures)
            else:
                yield _numbers(family, self._figures)


def _numbers(family: Family, figures: Figures) -> Metric:
    of_kind = CounterMetricFamily if family.kind is Kind.COUNTER else GaugeMetricFamily
    metric = of_kind(family.name, family.meaning, labels=family.labels)
    for labels, value in family.read(figures):
        assert not isinstance(value, TimeHistogram)
        metric.add_metric(labels, value)
    return metric


def _histogram(family: Family, figures: Figures) -> Metric:
    metric = HistogramMetricFamily(family.name, family.meaning, labels=family.labels)
    for labels, value in family.read(figures):
        assert isinstance(value, TimeHistogram)
        metric.add_metric(labels, _buckets(figures.metrics.bounds_s, value), value.sum_s)
    return metric


def _buckets(bounds_s: Seconds, times: TimeHistogram) -> list[tuple[str, float]]:
    """Counts up to each bound."""
    names = [*map(str, bounds_s.tolist()), "+Inf"]
    return list(zip(names, np.cumsum(times.counts).tolist(), strict=True))
