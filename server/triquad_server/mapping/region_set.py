"""The regions of a map, those in memory and those that are in the store alone."""

from collections.abc import Collection, Iterable, Iterator, KeysView, Mapping
from types import MappingProxyType

from triquad_format.mapfile.region_facts import RegionFacts
from triquad_format.records.field_settings import RegionIndex

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.epochs.epoch import EpochRegion
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.memory_budget import MemoryBudget
from triquad_server.mapping.region_setup import RegionSetup


class RegionSet:
    """Holds all regions of a map. To iterate yields those in memory; their number is that of all.

    They come in an order: those that no scan has reached for longest are first.
    """

    def __init__(self, setup: RegionSetup, budget: MemoryBudget) -> None:
        """Begin without regions, whose memory is estimated by a budget."""
        self._setup = setup
        self._budget = budget
        self._live: dict[RegionIndex, LiveRegion] = {}
        self.cold: dict[RegionIndex, ColdRegion] = {}  # those that are not in memory
        self.elsewhere: Mapping[RegionIndex, ColdRegion] = MappingProxyType({})
        """Those that other servers of a shared map have, as stores have them: they are read to
        answer questions, and count for nothing else."""

        self._rays_discarded = self._samples_discarded = 0  # of those that are not in memory
        self.version = 0  # grows where regions come or go, or leave memory

    def __len__(self) -> int:
        return len(self._live) + len(self.cold)

    def __iter__(self) -> Iterator[LiveRegion]:
        return iter(self._live.values())

    @property
    def indices(self) -> KeysView[RegionIndex]:
        """The indices of all regions."""
        return dict.fromkeys((*self._live, *self.cold)).keys()

    @property
    def in_memory(self) -> KeysView[RegionIndex]:
        """The indices of those in memory."""
        return self._live.keys()

    @property
    def samples_left(self) -> int:
        """The number of training samples that are still to be trained on."""
        left = sum(region.training.budget.samples for region in self)
        return left + sum(region.facts.samples_left for region in self.cold.values())

    @property
    def rays_kept(self) -> int:
        """The number of rays that are kept to train on; one that crosses regions counts in each."""
        kept = sum(len(region.training.rays.pool) for region in self)
        return kept + sum(region.facts.rays for region in self.cold.values())

    @property
    def rays_discarded(self) -> int:
        """The rays so far that were replaced by others, or were too many."""
        return self._rays_discarded + sum(one.training.rays.pool.discarded for one in self)

    @property
    def samples_discarded(self) -> int:
        """The samples so far that were beyond the limit of what may be left."""
        return self._samples_discarded + sum(one.training.budget.discarded for one in self)

    def bytes_of(self, indices: Collection[RegionIndex]) -> int:
        """Return the memory that some regions take, or would; an estimate."""
        cold = (self.cold[index].facts for index in indices if index in self.cold)
        live = (self._live[index].size for index in indices if index in self._live)
        return self._budget.bytes_of(live) + sum(facts.memory_bytes for facts in cold)

    def facts(self) -> dict[RegionIndex, RegionFacts]:
        """Return what a checkpoint tells of all regions, as they were published last."""
        live = {one.index: one.facts(self._budget.bytes_of([one.size])) for one in self}
        left = {i: one for i, one in self.elsewhere.items() if not one.is_foreign}
        return {index: region.facts for index, region in (left | self.cold).items()} | live

    def publish(self, epoch: int) -> tuple[EpochRegion, ...]:
        """Return all regions as they are now, for an epoch."""
        live, own = [region.publish(epoch) for region in self], self.indices
        others = [one for index, one in self.elsewhere.items() if index not in own]
        return (*live, *self.cold.values(), *others)

    def at(self, index: RegionIndex) -> LiveRegion:
        """Return a region that is in memory, or one of which nothing is known: it is not added."""
        return self._live.get(index) or LiveRegion(index, self._setup)

    def add(self, regions: Iterable[LiveRegion]) -> None:
        """Put regions at the end of the order; those that are new belong to the map from now on."""
        for region in regions:
            self.version += self._live.pop(region.index, None) is None
            self._live[region.index] = region

    def read(self, indices: Iterable[RegionIndex]) -> None:
        """Bring back those that are not in memory; errors are those of :class:`ColdRegion`."""
        for index in indices:
            if (cold := self.cold.get(index)) is not None:
                self._live[index] = LiveRegion(index, self._setup, cold.whole())
                del self.cold[index]
                self.version += 1

    def leave(self, stored: ColdRegion) -> None:
        """Have a region leave memory, which the store has as it is."""
        self._count_discarded(self._live.pop(stored.index))
        self.cold[stored.index] = stored
        self.version += 1

    def renew(self, stored: Mapping[RegionIndex, ColdRegion]) -> None:
        """Take newer parts of those that are not in memory."""
        self.cold = {index: stored.get(index, region) for index, region in self.cold.items()}

    def remove(self, indices: Iterable[RegionIndex]) -> None:
        """Remove regions from the map."""
        for index in indices:
            if (region := self._live.pop(index, None)) is not None:
                self._count_discarded(region)
            self.cold.pop(index, None)
        self.version += 1

    def restore_cold(self, regions: Mapping[RegionIndex, ColdRegion]) -> None:
        """Begin with regions as a checkpoint has them; each is read when a scan reaches it."""
        self.cold = dict(regions)
        self.version += 1

    def adopt(self, region: ColdRegion) -> None:
        """Have a region from now on that another server of a shared map had."""
        self.cold[region.index] = region
        self.elsewhere = {i: one for i, one in self.elsewhere.items() if i != region.index}
        self.version += 1

    def give(self, index: RegionIndex) -> ColdRegion | None:
        """Leave a region that is not in memory to another server of a shared map; return it.

        ``None``: it is in memory, or was removed meanwhile.
        """
        given = self.cold.pop(index, None)
        if given is None:
            return None
        self.elsewhere = {**self.elsewhere, index: given}
        self.version += 1
        return given

    def others_have(self, regions: Mapping[RegionIndex, ColdRegion]) -> None:
        """Take notice of what other servers of a shared map have."""
        if self.elsewhere != regions:
            self.elsewhere = regions
            self.version += 1

    def _count_discarded(self, region: LiveRegion) -> None:
        self._rays_discarded += region.training.rays.pool.discarded
        self._samples_discarded += region.training.budget.discarded
