"""Keeps the published states of the map that can be queried."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles

from triquad_server.epochs.epoch import Epoch
from triquad_server.settings import MemorySettings, ServiceSettings

_RECENT_PERIODS = 10
"""After this many of the periods in which epochs follow each other, only the newest is kept."""


class KeptEpochs(NamedTuple):
    """The epochs that can be queried."""

    epochs: tuple[Epoch, ...]  # the newest last
    pinned: int  # epochs of them that stay because they were requested by number
    newest_age_s: float


class EpochHistory:
    """Keeps the newest epochs, and older ones for a while after they were requested by number.

    Older ones stay while they fit in their memory: those that were requested last come first.
    """

    def __init__(
        self,
        first: Epoch,
        settings: ServiceSettings,
        clock: Callable[[], float] = time.monotonic,
        older_bytes: Callable[[], int] = lambda: MemorySettings().epochs_bytes,
    ) -> None:
        """Begin with the epoch that is published ``first``.

        Args:
            first: the newest, for now.
            settings: which epochs stay.
            clock: seconds that never run backwards.
            older_bytes: returns the memory that older epochs may take, beyond what they share with
                newer ones.
        """
        self.newest = first  # the epoch published last
        self.older_bytes = 0  # of older ones, beyond what they share with it
        self._lock = threading.Condition()
        self._settings = settings
        self._clock = clock
        self._most_older_bytes = older_bytes
        self._published_s = clock()  # when the newest was
        self._recent_s = _RECENT_PERIODS * settings.publish_period_s
        self._epochs = {first.number: first}  # oldest first
        self._pins: dict[int, float] = {}  # when an epoch was last requested, in that order
        self._viewed: Counter[int] = Counter()  # requests that are handled with an epoch, by number

    def add(self, epoch: Epoch) -> None:
        """Make ``epoch`` the newest; older ones may be removed."""
        with self._lock:
            self.newest = epoch
            self._published_s = self._clock()
            self._epochs[epoch.number] = epoch
            self._tidy()

    def remove_expired(self) -> None:
        """Remove the epochs that have expired.

        Call this from time to time: requests for the newest leave older ones as they are.
        """
        with self._lock:
            self._tidy()

    @property
    def is_recent(self) -> bool:
        """Return whether the newest was published a short time ago."""
        return self._clock() - self._published_s <= self._recent_s

    def kept(self) -> KeptEpochs:
        """Return the epochs that are kept now."""
        with self._lock:
            epochs = tuple(self._epochs.values())
            age_s = self._clock() - self._published_s
        return KeptEpochs(epochs, max(0, len(epochs) - self._settings.epochs_kept), age_s)

    def origin(self) -> Doubles:
        """Return from where the map counts: see :class:`Epoch`."""
        return self.newest.origin

    def get(self, number: int) -> Epoch:
        """Return the epoch of that number, or the newest for 0.

        Requesting an epoch by number pins it: a long request in many parts, or many requests that
        belong together, keep their epoch while they go on.

        Raises:
            RefusedError: ``epoch_gone``.
        """
        with self._lock:
            epoch = self._get(number)
            if number:  # one more pin may exceed a limit
                self._tidy()
            return epoch

    @contextmanager
    def view(self, number: int) -> Iterator[Epoch]:
        """Yield the epoch as :meth:`get` does; training gives way while the context is open.

        An epoch that becomes old meanwhile is pinned: the request may be the first of many, of
        which the next requests it by number.
        """
        with self._lock:
            epoch = self._get(number)
            self._viewed[epoch.number] += 1
            if number:  # as in get
                self._tidy()
        try:
            yield epoch
        finally:
            with self._lock:
                self._viewed -= Counter([epoch.number])
                if epoch is not self.newest:
                    self._pin(epoch.number)
                if not self._viewed:
                    self._lock.notify_all()

    def give_way(self, limit_s: float) -> None:
        """Return once no epoch is queried, or after ``limit_s``: so training never starves."""
        with self._lock:
            self._lock.wait_for(lambda: not self._viewed, limit_s)

    def _get(self, number: int) -> Epoch:
        epoch = self._epochs.get(number) if number else self.newest
        if epoch is None:
            kept = sorted(self._epochs)
            raise RefusedError(
                "epoch_gone",
                f"epoch {number} is not kept; kept are {kept}"
                if number < kept[-1]
                else f"there is no epoch {number} yet: the newest is {kept[-1]}",
            )
        if number:
            self._pin(number)
        return epoch

    def _pin(self, number: int) -> None:
        self._pins.pop(number, None)
        self._pins[number] = self._clock()

    def _tidy(self) -> None:
        """Remove older epochs that have expired, or that exceed a limit."""
        since = self._clock() - self._settings.pin_s
        kept = self._settings.epochs_kept if self.is_recent else 1
        recent = list(self._epochs)[-kept:]
        pinned = [number for number, asked_s in self._pins.items() if asked_s >= since]
        stay = {self.newest.number, *self._viewed}
        older = 0  # epochs that stay because they were requested
        counted = set(self.newest.buffers)  # memory of those that stay
        used = 0
        for number in (*reversed(pinned), *reversed(recent)):
            if number in stay or (number not in recent and older >= self._settings.epochs_pinned):
                continue
            buffers = self._epochs[number].buffers
            own = {start: size for start, size in buffers.items() if start not in counted}
            if used + sum(own.values()) <= self._most_older_bytes():
                used += sum(own.values())
                counted.update(own)
                stay.add(number)
                older += number not in recent
        self.older_bytes = used
        self._epochs = {number: epoch for number, epoch in self._epochs.items() if number in stay}
        self._pins = {number: at_s for number, at_s in self._pins.items() if number in stay}
