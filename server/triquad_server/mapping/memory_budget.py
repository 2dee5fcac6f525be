"""How much memory regions take, and how much they would."""

from collections.abc import Iterable

import numpy as np
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import BLOCK_BYTES
from triquad_map.evidence.growth import EvidenceSize
from triquad_map.evidence.observed import OBSERVED_VOXEL

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.live_region import LiveRegion, RegionSize
from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.process.memory_share import MemoryShare
from triquad_server.settings import TrainingSettings

_ROOM = 1.15
"""The ratio of allocated to used memory: spare room to grow, and pieces between arrays."""

_REGION_BYTES = 600_000  # of a region in which nothing is known yet
_SLOT_BYTES = 3 * 12  # of an index, for each cell: two to four slots of a key and a row
_SURFEL_BYTES = 160  # with its place, its confidence and its lane in the tree
_BLOCK_BOX_BYTES = 32  # of a block with surfels
_VERTEX_ENTRIES = 4  # entries of a vertex, in the blocks of the tree that it lies in
_NUMBER_BYTES = 4  # of each trained number
_MOST_VERTICES = 12  # most new ones on each level, of a new voxel

_COPY = 0.75
"""What the copy of a region takes of its bytes, with what is made of it in turn (157 of 215 MB for
205 m of a street)."""

_RESERVE = 0.05
"""The share of the limit that stays free for scans, while the coldest can go to make room."""

_BETWEEN = 0.12
"""The share of the limit that is lost between pieces of memory, or in use for a moment, as while a
mesh is made: with half of it a drive of 17 km peaked 7 % above."""

_RAYS_SHARE = 0.25
"""The share of the limit that kept rays may take: a region that is mapped takes three times as much
for all else."""


class MemoryBudget:
    """Estimates the bytes that regions take: live, with their rays, and in the newest epoch."""

    def __init__(
        self, memory: MemoryShare, field: FieldSettings, training: TrainingSettings
    ) -> None:
        """Let regions of such a ``field`` take a share of the server's memory."""
        self.memory = memory
        self._most_pool_bytes = training.pool_bytes
        self.rays_per_voxel = training.rays_per_voxel
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

    @property
    def pool_bytes(self) -> int:
        """The bytes that kept rays may take."""
        return min(self._most_pool_bytes, int(_RAYS_SHARE * self.memory.limit))

    @property
    def room(self) -> int:
        """The bytes that all regions may take now."""
        return int((1 - _BETWEEN) * self.memory.limit) - self.memory.reserved()

    @property
    def reserve(self) -> int:
        """The bytes that stay free for scans while regions can go."""
        return int(_RESERVE * self.memory.limit)

    def left(
        self, sizes: Iterable[RegionSize], copied: Iterable[RegionSize], *, are_kept: bool
    ) -> int:
        """Return the bytes that are left beside regions; less than 0: there are too few.

        Copies of some wait to be written. Of those that ``are_kept`` in a store, one of the largest
        counts as well.
        """
        taken = [self.bytes_of([size]) for size in sizes]
        being_written = int(_COPY * max(taken, default=0)) if are_kept else 0
        return self.room - sum(taken) - self.copy_bytes(copied) - being_written

    def copy_bytes(self, sizes: Iterable[RegionSize]) -> int:
        """Return the bytes of copies of some regions, from which a checkpoint is written."""
        return int(_COPY * self.bytes_of(sizes))

    def bytes_of(self, regions: Iterable[RegionSize]) -> int:
        """Return the bytes that regions take, with the newest epoch of them."""
        return sum(_REGION_BYTES + self.grown(region) for region in regions)

    def grown(self, by: RegionSize) -> int:
        """Return the additional bytes that a region takes when it grows."""
        (blocks, surface_blocks, voxels), vertices, rays = by
        used = blocks * self._block_bytes + surface_blocks * self._surface_block_bytes
        used += voxels * self._voxel_bytes + vertices * self._vertex_bytes
        return int(_ROOM * used) + rays * RAY_BYTES

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

    def added(self, rays: ScanRays, reached: Iterable[LiveRegion], unseen: int) -> int:
        """Return the bytes that a scan adds to regions, of which ``unseen`` are new."""
        new = RegionSize(EvidenceSize(0, 0, 0), 0)
        grown = sum(self.grown(region.growth_by(rays)) for region in reached)
        return self.bytes_of([new] * unseen) + grown

    def refusal(self, used: int, needed: int) -> ScanRefusedError:
        """Return the refusal of a scan that needs ``needed`` bytes more than the ``used`` ones."""
        return ScanRefusedError(
            "map_full",
            f"the map takes {used / 1e6:.0f} MB and the scan would add some {needed / 1e6:.1f} MB, "
            f"more than there is room for ({self.memory}): raise that, reset what is no longer "
            "needed, start the server with --store, so that what was not seen for long can leave "
            "memory, or use a larger field.leaf_m for a new map",
        )
