"""The regions of the live map: made as scans enter them, within the limits of the map."""

import itertools
import math
from collections.abc import Collection, Iterable, Iterator

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import Region

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.memory_budget import NO_SIZE, MemoryBudget
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.training_budget import FairShare


def regions_around(
    rays: ScanRays, there: Collection[RegionIndex], field: FieldSettings
) -> list[RegionIndex]:
    """Return regions whose cubes hold an end point or the sensor, and existing ones in between.

    Rays that met nothing, and the robot, make no region: they are recorded in existing ones.
    """
    half = field.region_side_m / 2
    pitch = field.region_pitch_m

    def spanned(column: Doubles) -> range:
        low, high = column.min() - half, column.max() + half
        return range(math.floor(low / pitch) + 1, math.ceil(high / pitch))

    columns = [np.append(rays.ends[:, axis], rays.origin[axis]) for axis in range(3)]
    x, y, z = map(spanned, columns)
    around = list(itertools.product(x, y, z))

    def holds_any(index: RegionIndex) -> bool:
        near = [np.abs(column - i * pitch) < half for column, i in zip(columns, index, strict=True)]
        return bool((near[0] & near[1] & near[2]).any())

    if len(around) > 1:
        around = [index for index in around if index in there or holds_any(index)]
    free = rays.free_corners
    reached = [spanned(np.append(columns[axis], free[:, axis])) for axis in range(3)]
    return around + [
        index
        for index in there
        if index not in around and all(map(range.__contains__, reached, index))
    ]


class LiveRegions:
    """Holds all regions of a map; only the thread that owns the map may use them."""

    def __init__(self, setup: RegionSetup, max_bytes: int) -> None:
        """Begin without regions; they may take ``max_bytes``, with the newest epoch of them."""
        self._setup = setup
        self._budget = MemoryBudget(max_bytes, setup.field)
        self._regions: dict[RegionIndex, LiveRegion] = {}
        self._share = FairShare.of(0, setup.training)

    def __len__(self) -> int:
        return len(self._regions)

    def __iter__(self) -> Iterator[LiveRegion]:
        return iter(self._regions.values())

    @property
    def bytes_used(self) -> int:
        """Return the memory of the regions with the newest epoch, without rays; an estimate."""
        return self._budget.bytes_of(region.size for region in self)

    @property
    def samples_left(self) -> int:
        """The number of training samples that are still to be trained on."""
        return sum(region.training.budget.samples for region in self)

    @property
    def rays_share(self) -> float:
        """The share of the rays that each place is to keep that memory has room for."""
        return self._share.rays_share

    @property
    def next_to_learn(self) -> LiveRegion | None:
        """Return the region with most samples per vertex to train on; None: all have settled."""
        region = max(self, key=lambda r: r.training.samples_per_vertex, default=None)
        return None if region is None or region.training.is_settled else region

    def restore(self, records: Iterable[Region]) -> None:
        """Add the regions of a record; :meth:`share_out` sets what they may keep."""
        for record in records:
            self._regions[record.index] = LiveRegion(record.index, self._setup, record)

    def reached_by(self, rays: ScanRays) -> list[LiveRegion]:
        """Return the regions that a scan enters; new ones belong to the map from now on.

        Raises:
            ScanRefusedError: the map would have too many regions, or take too much memory.
        """
        around = regions_around(rays, self._regions, self._setup.field)
        limit = self._setup.training.max_regions
        count = len(self._regions.keys() | set(around))
        if count > limit:
            raise ScanRefusedError(
                "too_many_regions",
                f"the scan would make {count} regions of the map, more than "
                f"training.max_regions = {limit}",
            )
        reached = {
            index: self._regions.get(index) or LiveRegion(index, self._setup) for index in around
        }
        self._check_memory(rays, list(reached.values()))
        self._regions.update(reached)
        return list(reached.values())

    def share_out(self) -> None:
        """Let all places keep as many rays, and be trained on as many samples at most."""
        voxels = [(region, region.evidence.live.surface_voxels) for region in self]
        self._share = FairShare.of(sum(count for _, count in voxels), self._setup.training)
        for region, count in voxels:
            region.training.limit(self._share, count)

    def forget(self, minimum: Doubles, maximum: Doubles) -> None:
        """Forget what lies between two corners [3], map frame, and all regions that lie there."""
        half = self._setup.field.region_side_m / 2
        for index, region in list(self._regions.items()):
            low, high = region.centre - half, region.centre + half
            if ((minimum <= low) & (maximum >= high)).all():
                del self._regions[index]
            elif ((minimum < high) & (maximum > low)).all():
                region.forget(np.maximum(minimum, low), np.minimum(maximum, high))
        self.share_out()

    def _check_memory(self, rays: ScanRays, reached: list[LiveRegion]) -> None:
        """Refuse a scan that does not fit; the closer to the limit, the more exact the count.

        Raises:
            ScanRefusedError: ``map_full``.
        """
        used, budget = self.bytes_used, self._budget
        if used + budget.most_added(rays, [len(rays.ends)] * len(reached)) <= budget.limit:
            return
        if used + budget.most_added(rays, [r.new_voxels(rays) for r in reached]) <= budget.limit:
            return
        unseen = budget.bytes_of(NO_SIZE for r in reached if r.index not in self._regions)
        needed = unseen + sum(budget.grown(region.growth_by(rays)) for region in reached)
        if needed and used + needed > budget.limit:
            raise budget.refusal(used, needed)
