"""The published states of the map: what each answers, and which can be asked for."""

import threading
import time
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

from triquad_server.engine.live_field import FrozenField, region_record
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

    def record(self) -> MapRecord:
        """The epoch as a map file holds it, without training state."""
        regions = tuple(region.record() for region in self.frozen_regions)
        return MapRecord(self._name, self.number, settings=self.field_settings, regions=regions)


class KeptEpochs(NamedTuple):
    """The epochs that can be asked for."""

    epochs: tuple[Epoch, ...]  # the newest last
    pinned: int  # of them, which stay because they were asked for by number
    newest_age_s: float


class EpochHistory:
    """The newest epochs, and older ones while they are asked for by number."""

    def __init__(
        self, first: Epoch, settings: ServiceSettings, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``settings`` tell which epochs stay, ``clock`` seconds that never run backwards."""
        self.gate = QueryGate()
        self.newest = first  # the epoch published last
        self._lock = threading.Lock()
        self._settings = settings
        self._clock = clock
        self._published_s = clock()  # when the newest was
        self._epochs = {first.number: first}  # oldest first
        self._asked: dict[int, float] = {}  # when, by number; longest ago first

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
                self._asked.pop(number, None)
                self._asked[number] = self._clock()
            self._tidy()
            return epoch

    @contextmanager
    def view(self, number: int) -> Iterator[Epoch]:
        """As :meth:`get`; training gives way while the epoch is asked."""
        with self.gate.query():
            yield self.get(number)

    def _tidy(self) -> None:
        """Let go of older epochs whose time is over, or that exceed the limit."""
        older = list(self._epochs)[: -self._settings.epochs_kept]
        since = self._clock() - self._settings.pin_s
        pinned = [n for n, asked in self._asked.items() if n in older and asked >= since]
        stay = pinned[max(0, len(pinned) - self._settings.epochs_pinned) :]
        for number in older:
            if number not in stay:
                del self._epochs[number]
                self._asked.pop(number, None)
