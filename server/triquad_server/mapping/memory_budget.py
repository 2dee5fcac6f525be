"""Estimates how much memory the map takes, and whether a scan still fits."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import BLOCK_BYTES
from triquad_map.evidence.growth import EvidenceSize
from triquad_map.evidence.observed import OBSERVED_VOXEL

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import ScanRays

_ROOM = 1.15
"""The ratio of allocated to used memory: spare room to grow, and pieces between arrays."""

_REGION_BYTES = 600_000  # of a region in which nothing is known yet
_SLOT_BYTES = 3 * 12  # of an index, for each cell: two to four slots of a key and a row
_SURFEL_BYTES = 80  # with its place and its confidence
_BLOCK_BOX_BYTES = 32  # of a block with surfels
_VERTEX_ENTRIES = 4  # entries of a vertex, in the blocks of the tree that it lies in
_NUMBER_BYTES = 4  # of each trained number
_MOST_VERTICES = 12  # most new ones on each level, of a new voxel


class RegionSize(NamedTuple):
    """The size of what a region holds, or would hold in addition."""

    evidence: EvidenceSize
    vertices: int  # of its quadtrees


NO_SIZE = RegionSize(EvidenceSize(0, 0, 0), 0)
"""The size of a region in which nothing is known."""


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
