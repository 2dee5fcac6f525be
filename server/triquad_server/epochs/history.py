"""The published states of the map that can be asked for."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

from triquad_format.errors import RefusedError

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.query_gate import QueryGate
from triquad_server.net.asking_client import asking_client
from triquad_server.settings import MemorySettings, ServiceSettings

_RECENT_PERIODS = 10
"""For so many of the periods in which epochs follow each other the newest but one stay."""

_PINNED_SHARE = 0.5  # of the memory of older epochs, for those that are pinned


class KeptEpochs(NamedTuple):
    """The epochs that can be asked for."""

    epochs: tuple[Epoch, ...]  # the newest last
    pinned: int  # of them, which stay because they were asked for by number
    newest_age_s: float


@dataclass
class _Pin:
    """An epoch that a client asked for by number."""

    client: str
    number: int
    asked_s: float  # when it last did


class EpochHistory:
    """The newest epochs, and older ones while they are asked for by number.

    Older ones have a share of the memory, of which those that are pinned have at most half. A pin
    that is held goes for no other client's first; each client has a few.
    """

    def __init__(
        self,
        first: Epoch,
        settings: ServiceSettings,
        clock: Callable[[], float] = time.monotonic,
        older_bytes: int = MemorySettings().epochs_bytes,
    ) -> None:
        """Begin with the epoch that is published ``first``.

        Args:
            first: the newest, for now.
            settings: which epochs stay.
            clock: seconds that never run backwards.
            older_bytes: that older epochs may take, beyond what they share with newer ones.
        """
        self.gate = QueryGate()
        self.newest = first  # the epoch published last
        self._lock = threading.Lock()
        self._settings = settings
        self._clock = clock
        self._older_bytes = older_bytes
        self._published_s = clock()  # when the newest was
        self._recent_s = _RECENT_PERIODS * settings.publish_period_s
        self._epochs = {first.number: first}  # oldest first
        self._pins: list[_Pin] = []  # in the order in which they were first asked for
        self._viewed: Counter[int] = Counter()  # requests that are at work on an epoch, by number

    def add(self, epoch: Epoch) -> None:
        """Make ``epoch`` the newest; older ones may go."""
        with self._lock:
            self.newest = epoch
            self._published_s = self._clock()
            self._epochs[epoch.number] = epoch
            self._tidy()

    def let_go(self) -> None:
        """Let go of those whose time is over.

        To be called from time to time: those who ask for the newest leave older ones as they are.
        """
        with self._lock:
            self._tidy()

    @property
    def is_recent(self) -> bool:
        """Whether the newest was published a short time ago."""
        return self._clock() - self._published_s <= self._recent_s

    def kept(self) -> KeptEpochs:
        """What is kept now."""
        with self._lock:
            epochs = tuple(self._epochs.values())
            age_s = self._clock() - self._published_s
        return KeptEpochs(epochs, max(0, len(epochs) - self._settings.epochs_kept), age_s)

    def get(self, number: int) -> Epoch:
        """The epoch of that number, or the newest for 0.

        Asking for an epoch by number pins it: a long request in many parts, or many requests that
        belong together, do not lose their epoch while they go on.

        Raises:
            RefusedError: ``epoch_gone``.
        """
        with self._lock:
            epoch = self._get(number)
            if number:  # whoever pins may exceed a limit
                self._tidy()
            return epoch

    @contextmanager
    def view(self, number: int) -> Iterator[Epoch]:
        """As :meth:`get`; training gives way while the epoch is asked.

        An epoch that grows old meanwhile is pinned: the request may be the first of many parts, of
        which the next asks for it by number.
        """
        with self.gate.query():
            with self._lock:
                epoch = self._get(number)
                self._viewed[epoch.number] += 1
                if number:  # as in get
                    self._tidy()
            try:
                yield epoch
            finally:
                with self._lock:
                    self._viewed[epoch.number] -= 1
                    if not self._viewed[epoch.number]:
                        del self._viewed[epoch.number]
                    if epoch is not self.newest:
                        self._pin(asking_client.get(), epoch.number)

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
            self._pin(asking_client.get(), number)
        return epoch

    def _pin(self, client: str, number: int) -> None:
        """Note that a client asked for an epoch."""
        now = self._clock()
        for pin in self._pins:
            if (pin.client, pin.number) == (client, number):
                pin.asked_s = now
                return
        self._pins.append(_Pin(client, number, now))

    def _tidy(self) -> None:
        """Let go of older epochs whose time is over, or that exceed a limit."""
        kept = self._settings.epochs_kept if self.is_recent else 1
        recent = list(self._epochs)[-kept:]
        room = _Room(self.newest, self._older_bytes)
        stay = {self.newest.number, *self._viewed}
        for number in self._pinned():
            pinned = stay.difference(recent, self._viewed)
            is_full = len(pinned) >= self._settings.epochs_pinned
            if number in stay or (is_full and number not in recent):
                continue
            if room.take(self._epochs[number], share=_PINNED_SHARE):
                stay.add(number)
        for number in reversed(recent):
            if number not in stay and room.take(self._epochs[number]):
                stay.add(number)
        self._epochs = {n: epoch for n, epoch in self._epochs.items() if n in stay}
        self._pins = [pin for pin in self._pins if pin.number in stay]

    def _pinned(self) -> Iterator[int]:
        """The epochs that clients may have pinned, those first that are to stay.

        Of each client the ones that it asked for last: first one of each, and first those of whom
        came first. Who has no name may be many, and comes after all others.
        """
        since = self._clock() - self._settings.pin_s
        by_client: dict[str, list[_Pin]] = {}
        for pin in self._pins:
            if pin.asked_s >= since:
                by_client.setdefault(pin.client, []).append(pin)
        for pins in by_client.values():
            pins.sort(key=lambda pin: -pin.asked_s)
        unnamed = by_client.pop("", [])
        for rank in range(self._settings.client_pins):
            yield from (pins[rank].number for pins in by_client.values() if rank < len(pins))
        yield from (pin.number for pin in unnamed)


class _Room:
    """What older epochs take, as they are chosen to stay."""

    def __init__(self, newest: Epoch, limit: int) -> None:
        self._counted = set(newest.buffers)  # memory of those that stay
        self._limit = limit
        self._used = 0

    def take(self, epoch: Epoch, share: float = 1.0) -> bool:
        """Have an epoch stay, where it fits in a share of the limit."""
        own = {start: size for start, size in epoch.buffers.items() if start not in self._counted}
        if self._used + sum(own.values()) > share * self._limit:
            return False
        self._used += sum(own.values())
        self._counted.update(own)
        return True
