"""Which regions of a map leave memory, so that there is room for what scans reach.

That are the coldest, those that no scan has reached for longest. As long as there is room, all
stay.
"""

from collections.abc import Collection, Mapping
from typing import NoReturn

from triquad_format.records.field_settings import RegionIndex

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.errors import NoRoomYetError
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.memory_budget import MemoryBudget
from triquad_server.mapping.region_set import RegionSet


class RegionRoom:
    """Makes room for regions, within a budget."""

    def __init__(self, regions: RegionSet, budget: MemoryBudget) -> None:
        """Make room among regions."""
        self._regions = regions
        self._budget = budget
        self._are_kept = False  # the store can be written to
        self._stored: Mapping[RegionIndex, ColdRegion] = {}  # as the store has them
        self._reached: Collection[RegionIndex] = ()  # by the last scan: they stay in memory
        self._reached_lately: set[RegionIndex] = set()
        self.given: frozenset[RegionIndex] = frozenset()
        """Those that leave memory in any case: another server of a shared map is to have them."""

        self.leaving: list[LiveRegion] = []
        """Those that leave memory as soon as the store has them as they are: they are not trained
        any more."""

        self._is_full = False  # a scan waits until these have left
        self._copied_first: list[LiveRegion] = []  # a scan waits for copies of these

    @property
    def is_full(self) -> bool:
        """Whether scans have to wait: until regions have left, or copies of some are taken."""
        return self._is_full or any(region.is_wanted for region in self._copied_first)

    @property
    def waits_for_store(self) -> bool:
        """Whether regions leave once the store has them, or a scan waits for that."""
        return bool(self.leaving) or self._is_full

    @property
    def left(self) -> int:
        """The bytes that are left for regions."""
        sizes = (region.size for region in self._regions)
        copied = (region.size for region in self._regions for _ in range(region.copies_waiting))
        return self._budget.left(sizes, copied, are_kept=self._are_kept)

    def reach(self, indices: Collection[RegionIndex]) -> None:
        """Have some regions stay in memory, which a scan reaches.

        Raises:
            NoRoomYetError: to read those that are not in memory there is no room before others have
                left.
            ScanRefusedError: there will be none.
        """
        self._reached, self._copied_first = indices, []
        self._reached_lately.update(indices)
        needed = self._regions.bytes_of([one for one in indices if one in self._regions.cold])
        if needed:
            self._claim(needed)

    def check_scan(self, rays: ScanRays, reached: list[LiveRegion]) -> None:
        """See that there is room for what a scan adds; the less there is, the more exactly.

        While a checkpoint is written, regions that a scan changes are copied before: for that there
        has to be room, too. Errors are those of :meth:`reach`.
        """
        left, budget = self.left, self._budget
        owed = [region for region in reached if region.is_owed]
        copies = budget.copy_bytes(region.size for region in owed)
        if owed and copies > left:
            self._wait_for(owed)
        left -= copies
        if budget.most_added(rays, [len(rays.ends)] * len(reached)) <= left:
            return
        if budget.most_added(rays, [region.new_voxels(rays) for region in reached]) <= left:
            return
        unseen = sum(region.index not in self._regions.in_memory for region in reached)
        if needed := budget.added(rays, reached, unseen):
            if owed and needed > left:
                self._wait_for(owed)
            self._claim(needed)

    def stored(self, regions: Mapping[RegionIndex, ColdRegion] | None) -> None:
        """Tell what the store has of the regions: those that it has as they are can leave.

        ``None``: it cannot be written to, and no others can leave before it can.
        """
        self._are_kept, self._is_full = regions is not None, False  # what waits is tried again
        self._stored = self._stored if regions is None else regions
        self._regions.renew(self._stored)
        self.make()

    def make(self, needed: int = 0) -> bool:
        """Let the coldest leave memory until ``needed`` bytes and the reserve are free.

        Those that the store has not as they are, leave once it has. Return whether there is room.
        """
        self.leaving = []
        excess = needed + self._budget.reserve - self.left
        promised = excess  # less what leaves later
        given = [one for one in self._regions if one.index in self.given]
        others = {*self._reached, *self.given}
        free = [one for one in self._regions if one.index not in others]
        for region in (*given, *free):
            if promised <= 0 and region.index not in self.given:
                break
            stored, nbytes = self._stored.get(region.index), self._budget.bytes_of([region.size])
            # While somebody wants a copy, its memory would not be free.
            if stored and region.is_as_of(stored.epoch) and not region.is_wanted:
                self._regions.leave(stored)
                excess -= nbytes
            elif self._are_kept:
                self.leaving.append(region)
            else:
                continue
            promised -= nbytes
        return excess <= 0

    def give(self, indices: frozenset[RegionIndex]) -> None:
        """Let some regions leave memory as soon as the store has them as they are."""
        if self.given or indices:
            self.given = indices
            self.make()

    def take_reached(self) -> set[RegionIndex]:
        """Return the regions that scans have reached since the last time."""
        reached, self._reached_lately = self._reached_lately, set()
        return reached

    def make_again(self) -> bool:
        """Do as :meth:`make` where nothing is needed; return whether a region has left.

        While regions wait to leave, nothing happens: a scan may need more than them.
        """
        version = self._regions.version
        if not self.waits_for_store:
            self.make()
        return self._regions.version != version

    def has(self, needed: int) -> bool:
        """Return whether ``needed`` bytes are left, once what can leave memory has left.

        What was read to answer questions gives way, too, where that does not suffice.
        """
        if self.make(needed) or needed <= self.left:
            return True
        self._budget.memory.drop()
        return self.make(needed) or needed <= self.left

    def begin_again(self) -> None:
        """Have scans that wait tried again: regions were removed."""
        self._is_full, self.leaving = False, []

    def _claim(self, needed: int) -> None:
        """See that there is room for a scan; errors are those of :meth:`reach`."""
        if self.has(needed):
            return
        if self.leaving:
            self._is_full = True
            raise NoRoomYetError
        if wanted := [region for region in self._regions if region.is_wanted]:
            self._wait_for(wanted)
        used = self._budget.bytes_of(region.size for region in self._regions)
        raise self._budget.refusal(used, needed)

    def _wait_for(self, copies_of: list[LiveRegion]) -> NoReturn:
        """Have a scan wait until copies of some regions are taken."""
        self._copied_first = copies_of
        raise NoRoomYetError
