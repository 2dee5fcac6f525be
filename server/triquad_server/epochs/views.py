"""The epochs as questions see them."""

from collections.abc import Iterator
from contextlib import contextmanager

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.gate import QueryGate
from triquad_server.epochs.history import EpochHistory


class EpochViews:
    """Hands out epochs; training gives way while one is asked."""

    def __init__(self, epochs: EpochHistory, gate: QueryGate) -> None:
        self._epochs = epochs
        self._gate = gate

    @contextmanager
    def view(self, number: int) -> Iterator[Epoch]:
        """The epoch of that number, or the newest for 0."""
        with self._gate.query():
            yield self._epochs.get(number)
