"""A metric that Prometheus is told: its name, kind, labels, and where it comes from."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from triquad_format.wire.messages import ServerStatus
from triquad_format.wire.metrics_messages import ServerMetrics, TimeHistogram


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


def single(read: Callable[[Figures], float | None]) -> Read:
    """The only value of a metric without labels; none where ``read`` gives ``None``."""

    def values(figures: Figures) -> Iterator[Value]:
        value = read(figures)
        if value is not None:
            yield Value((), value)

    return values


def each(read: Callable[[Figures], Mapping[str, float]]) -> Read:
    """The values of a metric with one label."""

    def values(figures: Figures) -> Iterator[Value]:
        for label, value in read(figures).items():
            yield Value((label,), value)

    return values


def counter(name: str, meaning: str, read: Read, *labels: str) -> Family:
    """A metric that only grows, and begins anew with the process."""
    return Family(name, Kind.COUNTER, meaning, labels, read)


def gauge(name: str, meaning: str, read: Read, *labels: str) -> Family:
    """A metric that rises and falls."""
    return Family(name, Kind.GAUGE, meaning, labels, read)


def histogram(name: str, meaning: str, read: Read, *labels: str) -> Family:
    """A metric that counts how long something took."""
    return Family(name, Kind.HISTOGRAM, meaning, labels, read)
