"""Questions that a page asks over and over, so that they stand in nobody's way."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar

import numpy as np
from triquad_client.calls.queries import MapQueries
from triquad_format.errors import RefusedError

_ATTEMPTS = 3
_LEAST_S = 2.0  # from one time to the next
_SHARE = 0.1  # of the time is spent with asking


class OfEpoch(Protocol):
    """An answer."""

    @property
    def epoch(self) -> int:
        """The published state of the map that it is from."""


AnswerT = TypeVar("AnswerT", bound=OfEpoch)


def newest_epoch(queries: MapQueries) -> int:
    """The number of the map's newest epoch, a published state of it.

    Raises:
        TriquadError: the map does not answer.
    """
    return queries.query_sdf(np.zeros((0, 3))).epoch


def in_small_parts(
    ask: Callable[[slice, int | None], AnswerT], count: int, most: int
) -> list[AnswerT]:
    """The answers about ``count`` items of one epoch, one request of ``most`` items at a time.

    What others ask goes between. ``ask`` takes items and an epoch, ``None`` for the newest.

    Raises:
        TriquadError: the map does not answer.
    """
    attempts = 0
    while True:
        try:
            first = ask(slice(0, most), None)
            starts = range(most, count, most)
            return [first, *(ask(slice(at, at + most), first.epoch) for at in starts)]
        except RefusedError as error:
            attempts += 1
            if error.code != "epoch_gone" or attempts == _ATTEMPTS:
                raise


class Pace:
    """How soon something may be asked again because the map went on.

    Not before two seconds, and so that no more than a tenth of the time goes with it.
    """

    def __init__(self) -> None:
        self._due_s = -np.inf

    @property
    def due(self) -> bool:
        """Whether it may be asked now."""
        return time.monotonic() >= self._due_s

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Time what is asked within."""
        start = time.monotonic()
        try:
            yield
        finally:
            end = time.monotonic()
            self._due_s = end + max(_LEAST_S, (end - start) / _SHARE)
