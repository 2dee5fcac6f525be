"""The regions of the live map: made as scans enter them, within the limits of the map."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import Region
from triquad_format.wire.status_messages import FieldFit
from triquad_map import field_fit

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.memory_budget import MemoryBudget
from triquad_server.mapping.region_reach import regions_around
from triquad_server.mapping.region_room import RegionRoom
from triquad_server.mapping.region_set import RegionSet
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay.kept_rays import RAY_BYTES

_RAYS_STEP = 1.1
"""The factor between the possible numbers of rays per voxel: changing it is expensive, so it is
done seldom."""

_MOST_PER_RAY = 20.0
"""Samples that may be left, for each ray that the map is to keep."""


@dataclass(frozen=True)
class FairShare:
    """The share of a voxel with surface, the same everywhere: all places are learnt alike."""

    rays: float  # rays that are kept
    samples: float  # samples that may be left to train on
    rays_share: float  # share of `training.rays_per_voxel` that memory has room for

    @classmethod
    def of(cls, voxels: int, budget: MemoryBudget) -> "FairShare":
        """Return the share where ``voxels`` voxels with surface are in memory."""
        wanted = budget.rays_per_voxel
        kept = min(wanted, budget.pool_bytes / RAY_BYTES / max(1, voxels))
        return cls(
            rays=_RAYS_STEP ** math.floor(math.log(kept, _RAYS_STEP)),
            samples=_MOST_PER_RAY * wanted,
            rays_share=kept / wanted,
        )


class LiveRegions:
    """Holds all regions of a map; only the thread that owns the map may use them.

    To iterate yields those in memory; their number is that of all.
    """

    def __init__(
        self, setup: RegionSetup, budget: MemoryBudget, only: frozenset[RegionIndex] | None = None
    ) -> None:
        """Begin without regions.

        What enters others than ``only`` some is left out there; ``None``: any may be made.
        """
        self._setup = setup
        self._budget = budget
        self.all = RegionSet(setup, budget)
        self.room = RegionRoom(self.all, budget)
        self._share = FairShare.of(0, budget)
        self._only = only
        # Whether it may have a region: of a shared map, this also takes one that nobody has.
        self.may_have: Callable[[RegionIndex], bool] = lambda index: only is None or index in only

    def __len__(self) -> int:
        return len(self.all)

    def __iter__(self) -> Iterator[LiveRegion]:
        return iter(self.all)

    def beginning(self, only: frozenset[RegionIndex]) -> "LiveRegions":
        """Return none yet, of the same kind, of a map that has ``only`` some."""
        return LiveRegions(self._setup, self._budget, only)

    @property
    def field(self) -> FieldSettings:
        """The settings of all fields."""
        return self._setup.field

    @property
    def bytes_used(self) -> int:
        """Return the memory of the regions with their rays and the newest epoch; an estimate."""
        return self._budget.bytes_of(region.size for region in self)

    @property
    def rays_share(self) -> float:
        """The share of the rays that each place is to keep that memory has room for."""
        return self._share.rays_share

    @property
    def fit(self) -> FieldFit | None:
        """How well regions fit the held-out rays, as they were judged last; ``None``: none was."""
        fits = [(r.centre, r.training.fit) for r in self if r.training.fit is not None]
        return field_fit.map_fit(fits)

    @property
    def next_to_learn(self) -> LiveRegion | None:
        """Return the region with most samples per vertex to train on; ``None``: there is none.

        Regions that leave memory are not trained, and those that are owed a copy not until then.
        """
        leaving = self.room.leaving
        staying = [one for one in self if one not in leaving and not one.is_owed]
        region = max(staying, key=lambda r: r.training.samples_per_vertex, default=None)
        return None if region is None or region.training.is_settled else region

    def restore(self, records: Iterable[Region]) -> None:
        """Add the regions of a record; :meth:`share_out` sets what they may keep."""
        self.all.add(LiveRegion(record.index, self._setup, record) for record in records)

    def reached_by(self, rays: ScanRays) -> list[LiveRegion]:
        """Return the regions that a scan enters; new ones belong to the map from now on.

        There are none where all that it enters are not of this map, or of another server's.

        Raises:
            NoRoomYetError: there is room for it once other regions have left memory.
            ScanRefusedError: the map would have too many regions, or take too much memory, or a
                region cannot be read.
        """
        there = self.all.indices
        around = regions_around(rays, there, self._setup.field)
        around = [index for index in around if self.may_have(index)]
        limit = self._setup.training.max_regions
        count = len({*there, *around})
        if count > limit:
            raise ScanRefusedError(
                "too_many_regions",
                f"the scan would make {count} regions of the map, more than "
                f"training.max_regions = {limit}",
            )
        self.room.reach(around)
        try:
            self.all.read(around)
        except RefusedError as error:
            raise ScanRefusedError(error.code, error.message) from error
        reached = [self.all.at(index) for index in around]
        self.room.check_scan(rays, reached)
        self.all.add(reached)
        return reached

    def replace(self, others: "LiveRegions") -> None:
        """Have what another map has of the regions that it may have, in place of those here.

        Raises:
            RefusedError: ``busy``; there would be too many, or they would take too much memory.
        """
        only = others._only or frozenset()
        there = set(self.all.indices) - only | set(others.all.indices)
        before = self._budget.bytes_of(one.size for one in self if one.index in only)
        more = max(0, others.bytes_used - before)
        if not self.room.has(more) or len(there) > self._setup.training.max_regions:
            used = self.bytes_used + more
            raise RefusedError(
                "busy",
                f"the map would have {len(there)} regions and take {used / 1e6:.0f} MB, more than "
                f"training.max_regions = {self._setup.training.max_regions} or "
                f"{self._budget.memory} allows: start the server with more",
            )
        self.all.remove(only)
        self.all.add(others)
        self.room.begin_again()
        self.share_out()

    def share_out(self) -> None:
        """Let all places keep as many rays, and be trained on as many samples at most."""
        voxels = [(region, region.evidence.live.surface_voxels) for region in self]
        self._share = FairShare.of(sum(count for _, count in voxels), self._budget)
        for region, count in voxels:
            region.training.limit(
                max(1, int(self._share.rays * count)), int(self._share.samples * count)
            )

    def forget(self, minimum: Doubles, maximum: Doubles) -> None:
        """Forget what lies between two corners [3], map frame, and all regions that lie there.

        Raises:
            RefusedError: a region of which a part stays cannot be read, or there is no room for it.
        """
        half = self._setup.field.region_side_m / 2
        gone, cut = [], []
        for index in self.all.indices:
            centre = self._setup.field.region_centre(index)
            low, high = centre - half, centre + half
            if ((minimum <= low) & (maximum >= high)).all():
                gone.append(index)
            elif ((minimum < high) & (maximum > low)).all():
                cut.append((index, np.maximum(minimum, low), np.minimum(maximum, high)))
        read = [index for index, _, _ in cut if index in self.all.cold]
        if read and not self.room.has(self.all.bytes_of(read)):
            raise RefusedError(
                "busy",
                f"parts of {len(read)} regions that are not in memory would be reset, and there is "
                "no room to read them all: reset smaller boxes, or whole regions",
            )
        self.all.read(read)
        for index, low, high in cut:
            self.all.at(index).forget(low, high)
        self.all.remove(gone)
        self.room.begin_again()
        self.share_out()

    def fetch_unsettled(self) -> bool:
        """Bring back a region that has more to learn, if there is one and room for it."""
        stay = (one for index, one in self.all.cold.items() if index not in self.room.given)
        unsettled = (one for one in stay if one.facts.samples_left)
        region = min(unsettled, key=lambda one: one.facts.memory_bytes, default=None)
        if region is None or not self.room.has(region.facts.memory_bytes):
            return False
        try:
            self.all.read([region.index])
        except RefusedError:  # which the log tells
            region.facts = replace(region.facts, samples_left=0)
            return False
        self.share_out()
        return True
