"""Numbers that stand for one epoch of each server of a shared map."""

import threading
from collections import OrderedDict
from collections.abc import Mapping

from triquad_format.errors import RefusedError

_KEPT = 256
"""Numbers that are remembered; the one that was used longest ago is forgotten."""

Epochs = Mapping[int, int]
"""The epoch of each server, by the server's number."""


class SharedEpochs:
    """Remembers what numbers stand for; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._epochs: OrderedDict[int, Epochs] = OrderedDict()
        self._last = 0

    def of(self, number: int) -> Epochs:
        """Return what a number stands for.

        Raises:
            RefusedError: ``epoch_gone``: that is not known, or a server has gone since.
        """
        with self._lock:
            known = self._epochs.get(number)
            if known is not None:
                self._epochs.move_to_end(number)
        if known is None:
            raise RefusedError(
                "epoch_gone",
                f"epoch {number} is not known to this client, or one of the servers that share "
                "the map has gone since: ask the newest",
            )
        return known

    def number(self, epochs: Epochs) -> int:
        """Return the number that stands for some epochs: rising, and no less than any of them."""
        with self._lock:
            for number, known in self._epochs.items():
                if known == epochs:
                    return number
            self._last = max(self._last + 1, *epochs.values())
            self._epochs[self._last] = epochs
            if len(self._epochs) > _KEPT:
                self._epochs.popitem(last=False)
            return self._last

    def extended(self, number: int, epochs: Epochs) -> Epochs:
        """Return all that a number stands for; those of servers that it lacks belong to it now.

        Raises:
            RefusedError: ``epoch_gone``, as :meth:`of`.
        """
        known = self.of(number)
        with self._lock:
            if number in self._epochs:
                self._epochs[number] = known = {**epochs, **self._epochs[number]}
            return known

    def forget(self, server: int) -> None:
        """Forget the numbers that stand for an epoch of a server, which has gone."""
        with self._lock:
            for number in [one for one, epochs in self._epochs.items() if server in epochs]:
                del self._epochs[number]
