"""Regions that are in no memory: they are read from their parts where they are asked about."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

from triquad_format.mapfile.manifest import Entry
from triquad_format.mapfile.parts.part import EVIDENCE, FIELD_TOPICS, REGION, REGION_TOPICS
from triquad_format.mapfile.region_facts import RegionFacts
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord, Region
from triquad_map.compiled.team import Split
from triquad_map.composition.recorded_region import RecordedRegion
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import FrozenField
from triquad_map.surfels.surfel_map import SurfelMap

from triquad_server.epochs.buffers import Buffers, buffers_of

_CUBE_VOXELS = 128
"""The side of the cubes whose surfels are fitted together: 26 m at the default leaf. Those of a
street in one take some 40 ms on two cores; those of a region of 205 m take 330."""

ReadParts = Callable[["ColdRegion", Collection[str]], MapRecord]
"""Reads the parts of a region of some topics."""


@dataclass(eq=False)
class ColdRegion:
    """A region as a checkpoint has it: its parts, and what is known without reading them.

    All that has to be read raises :class:`triquad_format.errors.RefusedError` where it cannot be.
    """

    index: RegionIndex
    centre: Doubles  # [3] map frame
    facts: RegionFacts
    epoch: int  # of the checkpoint: it has not changed since
    entries: tuple[Entry, ...]  # of its parts; of older ones, where one was found damaged
    cache: "RegionCache"
    is_foreign: bool = False  # it is in the store of another server of a shared map
    reading: threading.Lock = field(default_factory=threading.Lock)

    @property
    def field(self) -> FrozenField:
        """Its field, as the parts have it."""
        return self.cache.get(self).field

    @property
    def evidence(self) -> FrozenEvidence:
        """The space that rays have shown of it."""
        return self.cache.get(self).evidence

    @property
    def newest_s(self) -> int:
        """When a ray last ended anywhere in it, seconds since 1970; 0: never, or not known."""
        return self.facts.newest_s

    @property
    def vertices(self) -> int:
        """The number of quadtree vertices, on all planes and levels."""
        return self.facts.vertices

    @property
    def parameters(self) -> int:
        """The number of learnable numbers."""
        return self.facts.parameters

    @property
    def buffers(self) -> Buffers:
        """The memory of it alone: none."""
        return {}

    def surfels_between(self, low: Doubles, high: Doubles) -> Sequence[SurfelMap]:
        """Return the surfels that may lie between two corners [3], map frame, and some around."""
        return self.cache.get(self).surfels_between(low, high)

    def read_evidence(self) -> FrozenEvidence:
        """Read the space that rays have shown of it alone: a seventh of the time of all."""
        record = self.cache.read(self, (REGION, EVIDENCE))
        side = 1 << record.settings.depth
        return FrozenEvidence.from_record(side, record.regions[0].evidence)

    def record(self) -> Region:
        """Return the region as a map file holds it, without training state."""
        return self.cache.read(self, FIELD_TOPICS).regions[0]

    def whole(self) -> Region:
        """Return the region with its training state."""
        return self.cache.read(self, REGION_TOPICS).regions[0]


class RegionCache:
    """Keeps regions that were read lately; those asked about longest ago give way."""

    def __init__(self, read: ReadParts, limit: Callable[[], int], split: Split) -> None:
        """Read regions by ``read``; at most ``limit()`` bytes stay, and the one read last.

        ``split`` shares the work of a question.
        """
        self.read = read
        self.bytes = 0  # of the regions that are kept
        self._limit = limit
        self._split = split
        self._lock = threading.Lock()
        self._kept: OrderedDict[ColdRegion, RecordedRegion] = OrderedDict()  # longest unused first

    def get(self, region: ColdRegion) -> RecordedRegion:
        """Return a region; who asks for one that is being read waits."""
        with region.reading:
            with self._lock:
                kept = self._kept.get(region)
                if kept is not None:
                    self._kept.move_to_end(region)
                    return kept
            record = self.read(region, FIELD_TOPICS)
            read = RecordedRegion(record, record.regions[0], self._split, _CUBE_VOXELS)
            with self._lock:
                self._kept[region] = read
                self._drop()
            return read

    def drop_all_but(self, regions: Mapping[RegionIndex, ColdRegion]) -> None:
        """Keep nothing of regions that are others by now."""
        with self._lock:
            for gone in [one for one in self._kept if regions.get(one.index) is not one]:
                del self._kept[gone]
            self._drop()

    def clear(self) -> None:
        """Keep nothing any more: who asks reads again."""
        with self._lock:
            self._kept.clear()
            self.bytes = 0

    def _drop(self) -> None:
        """Drop what is too much; surfels that were fitted since the last time count, too."""
        sizes = {one: sum(buffers_of(read).values()) for one, read in self._kept.items()}
        self.bytes = sum(sizes.values())
        while self.bytes > self._limit() and len(self._kept) > 1:
            dropped, _ = self._kept.popitem(last=False)
            self.bytes -= sizes[dropped]
