"""The surfels of a region of a record, with numpy alone."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.region import Evidence, seen_voxels, surface_counts

from triquad_map.nearest import NearestSurfels
from triquad_map.reference.seen_blocks import SeenBlocks
from triquad_map.reference.surfel_cloud import SurfelCloud
from triquad_map.surface.confidence import support_confidence
from triquad_map.surface.surfels import SampleField, fit_surfels


@dataclass(frozen=True)
class FittedSurfels:
    """The surfels of a region: S of them."""

    cloud: SurfelCloud
    confidence: Floats  # [S]
    seen_s: Longs  # [S]

    def __len__(self) -> int:
        return len(self.confidence)

    def find_nearest(self, points: Doubles, found: NearestSurfels) -> None:
        """Improve ``found`` where a surfel lies nearer to leaf coordinates ``points`` [N, 3]."""
        self.cloud.find_nearest(points, found)

    @classmethod
    def of(cls, record: Evidence, seen: SeenBlocks, field: SampleField) -> "FittedSurfels":
        """The surfels of all voxels in which rays ended; ``seen`` holds what ``record`` does."""
        voxels = seen_voxels(record, record.surface)
        surfels = fit_surfels(voxels, field, seen.ended_in)
        levels = np.zeros(len(voxels), np.uint8) if record.levels is None else record.levels
        seen_s = np.zeros(len(record.codes), np.int64) if record.seen_s is None else record.seen_s
        return cls(
            SurfelCloud(voxels, surfels),
            support_confidence(levels, surfels.kinds),
            np.repeat(seen_s, surface_counts(record.surface)),
        )
