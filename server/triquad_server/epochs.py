"""The published states of the map: what each answers, and which can be asked for."""

import threading
import time
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import MapRecord, Region
from triquad_map.compiled.evidence.evidence import FrozenEvidence
from triquad_map.compiled.surfels.surfel_map import SurfelMap
from triquad_map.composition.composed_view import ComposedView
from triquad_map.composition.region import Split

from triquad_server.array_memory import Buffers
from triquad_server.asking_client import asking_client
from triquad_server.engine.live_field import FrozenField, region_record
from triquad_server.memory_settings import MemorySettings
from triquad_server.query_gate import QueryGate
from triquad_server.settings import ServiceSettings


@dataclass(frozen=True)
class FrozenRegion:
    """A region as it was when it was published."""

    index: RegionIndex
    centre: Doubles  # [3] map frame
    engine: FrozenField
    evidence: FrozenEvidence
    surfels: SurfelMap
    vertices: int
    parameters: int
    changed: int  # epoch of its last change
    live_bytes: Mapping[str, int]  # what the live region took beside this one, by part
    buffers: Buffers  # memory of this one; other epochs may share it

    def record(self) -> Region:
        """The region as a map file holds it, without training state."""
        return region_record(self.index, self.engine, self.evidence, training=None)


class Epoch(ComposedView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        name: str,
        number: int,
        settings: FieldSettings,
        regions: tuple[FrozenRegion, ...],
        split: Split,
    ) -> None:
        """The map called ``name``; ``split`` runs the work of its answers."""
        super().__init__(number, settings, regions, split=split)
        self.number = number
        self.field_settings = settings
        self.frozen_regions = regions
        self._name = name

    @property
    def regions(self) -> int:
        """Regions of the map."""
        return len(self.frozen_regions)

    @property
    def vertices(self) -> int:
        """Quadtree vertices of all regions."""
        return sum(region.vertices for region in self.frozen_regions)

    @property
    def parameters(self) -> int:
        """Learnable numbers of all regions."""
        return sum(region.parameters for region in self.frozen_regions)

    @property
    def buffers(self) -> Buffers:
        """Its memory; epochs share that of what did not change between them."""
        return ChainMap(*(dict(region.buffers) for region in self.frozen_regions))

    def record(self) -> MapRecord:
        """The epoch as a map file holds it, without training state."""
        regions = tuple(region.record() for region in self.frozen_regions)
        return MapRecord(self._name, self.number, settings=self.field_settings, regions=regions)


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
    that is held goes for no other client's; each client has a few.
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
        self._epochs = {first.number: first}  # oldest first
        self._pins: list[_Pin] = []  # in the order in which they were first asked for

    def add(self, epoch: Epoch) -> None:
        """Make ``epoch`` the newest; older ones may go."""
        with self._lock:
            self.newest = epoch
            self._published_s = self._clock()
            self._epochs[epoch.number] = epoch
            self._tidy()

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
            epoch = self._epochs.get(number) if number else self.newest
            if epoch is None:
                raise RefusedError(
                    "epoch_gone", f"epoch {number} is not kept; kept are {sorted(self._epochs)}"
                )
            if number:
                self._pin(asking_client.get(), number)
            self._tidy()
            return epoch

    @contextmanager
    def view(self, number: int) -> Iterator[Epoch]:
        """As :meth:`get`; training gives way while the epoch is asked."""
        with self.gate.query():
            yield self.get(number)

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
        recent = list(self._epochs)[-self._settings.epochs_kept :]
        room = _Room(self.newest, self._older_bytes)
        stay = {self.newest.number}
        for number in self._pinned():
            is_full = len(stay.difference(recent)) >= self._settings.epochs_pinned
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

        Of each client the ones that it asked for last, and first those of whom came first. Who has
        no name may be many, and comes after all others.
        """
        since = self._clock() - self._settings.pin_s
        by_client: dict[str, list[_Pin]] = {}
        for pin in self._pins:
            if pin.asked_s >= since:
                by_client.setdefault(pin.client, []).append(pin)
        for client in sorted(by_client, key=lambda client: not client):
            newest_first = sorted(by_client[client], key=lambda pin: -pin.asked_s)
            most = self._settings.client_pins if client else len(newest_first)
            yield from (pin.number for pin in newest_first[:most])


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
