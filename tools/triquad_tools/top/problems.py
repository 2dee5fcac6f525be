"""What is out of order with a server, most serious first, in whole sentences."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from triquad_format.errors import ERROR_CODES

from triquad_tools.top.amounts import count, duration, rate
from triquad_tools.top.interval import Interval

_OVERDUE_EPOCH_S = 10.0  # while there is something to learn, two a second are published
_ALARMING_REFUSALS = ("busy", "internal")
"""Codes for which the server is to blame; others the client asked for, such as ``too_large``."""


class Grade(IntEnum):
    """How much something is out of order."""

    GOOD = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True)
class Problem:
    """Something that is out of order."""

    grade: Grade
    text: str


def problems(seen: Interval) -> tuple[Problem, ...]:
    """What is out of order now."""
    errors = [Problem(Grade.ERROR, text) for text in _errors(seen)]
    return (*errors, *(Problem(Grade.WARNING, text) for text in _warnings(seen)))


def _errors(seen: Interval) -> Iterator[str]:
    status, metrics = seen.sample.status, seen.sample.metrics
    if metrics is None:
        return
    if metrics.problem is not None:
        yield metrics.problem
    for name, queue in sorted(metrics.queues.items()):
        if queue.waiting >= queue.limit > 0:
            yield f"the queue of {name} is full: {count(queue.waiting)} wait"
    if metrics.epoch_age_s > _OVERDUE_EPOCH_S and not status.settled:
        left = f"{count(status.samples_left)} samples are left to learn"
        yield f"no new epoch for {duration(metrics.epoch_age_s)}, although {left}"


def _warnings(seen: Interval) -> Iterator[str]:
    if seen.restarted:
        yield "the server was restarted: its counts began anew"
    if seen.sample.metrics is None and seen.sample.status.store_error is not None:
        yield seen.sample.status.store_error  # it may have no store, as it should
    refused = seen.rates.requests_refused if seen.rates else {}
    for code in _ALARMING_REFUSALS:
        if refused.get(code, 0.0) > 0.0:
            yield f"{rate(refused[code])} requests a second are refused: {ERROR_CODES[code]}"
    yield from (seen.sample.status.warnings or "").splitlines()
