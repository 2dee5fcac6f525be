"""The epochs that requests can ask for."""

import threading
from collections import OrderedDict

from triquad_server.epoch import Epoch
from triquad_server.errors import RequestError


class EpochShelf:
    """The newest epoch, and those that were published or asked for last."""

    def __init__(self, first: Epoch, kept: int) -> None:
        self._lock = threading.Lock()
        self._kept = kept
        self._newest = first
        self._epochs: OrderedDict[int, Epoch] = OrderedDict({first.number: first})

    @property
    def newest(self) -> Epoch:
        """The epoch published last."""
        return self._newest

    def add(self, epoch: Epoch) -> None:
        """Make ``epoch`` the newest; the one that was used longest ago may go."""
        with self._lock:
            self._newest = epoch
            self._epochs[epoch.number] = epoch
            self._epochs.move_to_end(epoch.number)
            while len(self._epochs) > self._kept:
                self._epochs.popitem(last=False)

    def get(self, number: int) -> Epoch:
        """The epoch of that number, or the newest for 0.

        Asking for an epoch keeps it: a long request in many parts does not lose its epoch while
        it goes on.

        Raises:
            RequestError: ``epoch_gone``.
        """
        with self._lock:
            if number == 0:
                return self._newest
            epoch = self._epochs.get(number)
            if epoch is None:
                raise RequestError(
                    "epoch_gone",
                    f"epoch {number} is not kept; kept are {sorted(self._epochs)}",
                )
            self._epochs.move_to_end(number)
            self._epochs.move_to_end(self._newest.number)
            return epoch
