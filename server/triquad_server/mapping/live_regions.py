"""The regions of the live map: made as scans enter them, within the limits of the map."""

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings, RegionIndex
from triquad_format.records.region import BLOCK_BYTES, Region
from triquad_format.wire.status_messages import FieldFit
from triquad_map import field_fit
from triquad_map.evidence.growth import EvidenceSize
from triquad_map.evidence.observed import OBSERVED_VOXEL

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.live_region import LiveRegion, RegionSize
from triquad_server.mapping.region_reach import regions_around
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.settings import TrainingSettings

_RAYS_STEP = 1.1
"""The factor between the possible numbers of rays per voxel: changing it is expensive, so it is
done seldom."""

_MOST_PER_RAY = 20.0
"""Samples that may be left, for each ray that the map is to keep."""

_ROOM = 1.15
"""The ratio of allocated to used memory: spare room to grow, and pieces between arrays."""

_REGION_BYTES = 600_000  # of a region in which nothing is known yet
_SLOT_BYTES = 3 * 12  # of an index, for each cell: two to four slots of a key and a row
_SURFEL_BYTES = 80  # with its place and its confidence
_BLOCK_BOX_BYTES = 32  # of a block with surfels
_VERTEX_ENTRIES = 4  # entries of a vertex, in the blocks of the tree that it lies in
_NUMBER_BYTES = 4  # of each trained number
_MOST_VERTICES = 12  # most new ones on each level, of a new voxel

_NO_SIZE = RegionSize(EvidenceSize(0, 0, 0), 0)  # of a region in which nothing is known


class MemoryBudget:
    """Estimates the bytes that regions take: live, and in the newest epoch."""

    def __init__(self, limit: int, field: FieldSettings) -> None:
        """Let regions of such a ``field`` take at most ``limit`` bytes."""
        self.limit = limit
        self._block_m = BLOCK_VOXELS * field.leaf_m
        levels = 0 if field.encoding == "fourier" else field.feature_levels
        self._most_vertices = _MOST_VERTICES * levels  # of a new voxel
        masks = 2 * BLOCK_BYTES + 8 + _SLOT_BYTES
        self._block_bytes = 2 * masks + 24
        # The row of each voxel, in the live region only.
        self._surface_block_bytes = BLOCK_VOXELS**3 * _NUMBER_BYTES + 8 + _BLOCK_BOX_BYTES
        self._voxel_bytes = OBSERVED_VOXEL.itemsize + _SURFEL_BYTES
        # Values, with the optimiser's two moments and its steps; and values again.
        features = (3 * field.feature_size + 1 + field.feature_size) * _NUMBER_BYTES
        self._vertex_bytes = features + 9 + 2 * _VERTEX_ENTRIES * _NUMBER_BYTES

    def bytes_of(self, regions: Iterable[RegionSize]) -> int:
        """Return the bytes that regions take, with the newest epoch of them."""
        return sum(_REGION_BYTES + self.grown(region) for region in regions)

    def grown(self, by: RegionSize) -> int:
        """Return the additional bytes that a region takes when it grows."""
        (blocks, surface_blocks, voxels), vertices = by
        used = blocks * self._block_bytes + surface_blocks * self._surface_block_bytes
        used += voxels * self._voxel_bytes + vertices * self._vertex_bytes
        return int(_ROOM * used)

    def most_added(self, rays: ScanRays, new_voxels: Iterable[int]) -> int:
        """Return the most bytes that a scan may add to regions with these numbers of new voxels.

        It is found from the box around the scan's rays alone.
        """
        corners = np.concatenate([rays.origin[None], rays.ends, rays.free_corners])
        # Axis by axis: numpy is slow along rows of three.
        extent_m = np.ptp(np.ascontiguousarray(corners.T), axis=1)
        blocks = int(np.prod(extent_m / self._block_m + 2))
        return self.bytes_of(
            RegionSize(EvidenceSize(blocks, min(blocks, new), new), self._most_vertices * new)
            for new in new_voxels
        )

    def refusal(self, used: int, needed: int) -> ScanRefusedError:
        """Return the refusal of a scan that needs ``needed`` bytes more than the ``used`` ones."""
        return ScanRefusedError(
            "map_full",
            f"the map takes {used / 1e6:.0f} MB and the scan would add some {needed / 1e6:.1f} MB, "
            f"more than memory.max_bytes = {self.limit} allows: raise it, reset what is no longer "
            "needed, or use a larger field.leaf_m for a new map",
        )


@dataclass(frozen=True)
class FairShare:
    """The share of a voxel with surface, the same everywhere: all places are learnt alike."""

    rays: float  # rays that are kept
    samples: float  # samples that may be left to train on
    rays_share: float  # share of `training.rays_per_voxel` that memory has room for

    @classmethod
    def of(cls, voxels: int, training: TrainingSettings) -> "FairShare":
        """Return the share in a map of ``voxels`` voxels with surface."""
        wanted = training.rays_per_voxel
        kept = min(wanted, training.pool_bytes / RAY_BYTES / max(1, voxels))
        return cls(
            rays=_RAYS_STEP ** math.floor(math.log(kept, _RAYS_STEP)),
            samples=_MOST_PER_RAY * wanted,
            rays_share=kept / wanted,
        )


class LiveRegions:
    """Holds all regions of a map; only the thread that owns the map may use them."""

    def __init__(
        self, setup: RegionSetup, max_bytes: int, only: frozenset[RegionIndex] | None = None
    ) -> None:
        """Begin without regions; they may take ``max_bytes``, with the newest epoch of them.

        What enters others than ``only`` some is left out there; ``None``: any may be made.
        """
        self._setup = setup
        self._budget = MemoryBudget(max_bytes, setup.field)
        self._regions: dict[RegionIndex, LiveRegion] = {}
        self._share = FairShare.of(0, setup.training)
        self._only = only

    def __len__(self) -> int:
        return len(self._regions)

    def __iter__(self) -> Iterator[LiveRegion]:
        return iter(self._regions.values())

    @property
    def field(self) -> FieldSettings:
        """The settings of all fields."""
        return self._setup.field

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
    def fit(self) -> FieldFit | None:
        """How well regions fit the held-out rays, as they were judged last; ``None``: none was."""
        fits = [(r.centre, r.training.fit) for r in self if r.training.fit is not None]
        return field_fit.map_fit(fits)

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
        if self._only is not None:
            around = [index for index in around if index in self._only]
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

    def bytes_of(self, indices: Collection[RegionIndex]) -> int:
        """Return the memory that some regions take, with the newest epoch of them; an estimate."""
        return self._budget.bytes_of(region.size for region in self if region.index in indices)

    def replace(self, others: "LiveRegions") -> None:
        """Have what another map has of the regions that it may have, in place of those here.

        Raises:
            RefusedError: ``busy``; there would be too many, or they would take too much memory.
        """
        only = others._only or frozenset()
        left = {index: one for index, one in self._regions.items() if index not in only}
        regions = left | others._regions
        used, most = self._budget.bytes_of(one.size for one in regions.values()), self._budget.limit
        if used > most or len(regions) > self._setup.training.max_regions:
            raise RefusedError(
                "busy",
                f"the map would have {len(regions)} regions and take {used / 1e6:.0f} MB, more than"
                f" training.max_regions = {self._setup.training.max_regions} or memory.max_bytes ="
                f" {most} allows: start the server with more",
            )
        self._regions = regions
        self.share_out()

    def share_out(self) -> None:
        """Let all places keep as many rays, and be trained on as many samples at most."""
        voxels = [(region, region.evidence.live.surface_voxels) for region in self]
        self._share = FairShare.of(sum(count for _, count in voxels), self._setup.training)
        for region, count in voxels:
            region.training.limit(
                max(1, int(self._share.rays * count)), int(self._share.samples * count)
            )

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
        unseen = budget.bytes_of(_NO_SIZE for r in reached if r.index not in self._regions)
        needed = unseen + sum(budget.grown(region.growth_by(rays)) for region in reached)
        if needed and used + needed > budget.limit:
            raise budget.refusal(used, needed)
