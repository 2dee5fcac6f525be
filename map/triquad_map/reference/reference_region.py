"""One region of a record, answered with numpy alone."""

import threading
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.evidence_voxels import seen_voxels, surface_counts
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Region, region_centre

from triquad_map.composition.field_samples import field_samples
from triquad_map.composition.split import Split
from triquad_map.nearest import NearestSurfels
from triquad_map.reference.region_field import RegionField
from triquad_map.reference.seen_blocks import SeenBlocks
from triquad_map.reference.surfel_cloud import SurfelCloud
from triquad_map.surface.confidence import support_confidence
from triquad_map.surface.surfels import fit_surfels


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


class ReferenceRegion:
    """The region; its surfels are fitted when they are first asked for. For several threads."""

    def __init__(self, settings: FieldSettings, region: Region, split: Split) -> None:
        """``split`` cuts the work of fitting surfels."""
        self.index = region.index
        self.centre = region_centre(settings, region.index)
        self.engine = RegionField(settings, region)
        self.engine.add(region.tables)
        self.evidence = SeenBlocks(settings)
        self.evidence.add(region.evidence)
        self._record = region.evidence
        self._samples = field_samples(self.engine, settings, split)
        self._fitting = threading.Lock()
        self._surfels: FittedSurfels | None = None

    @property
    def surfels(self) -> FittedSurfels:
        """What stands for its surface; the first who asks waits until all are fitted."""
        with self._fitting:
            if self._surfels is None:
                self._surfels = self._fitted()
            return self._surfels

    def _fitted(self) -> FittedSurfels:
        record = self._record
        voxels = seen_voxels(record, record.surface)
        surfels = fit_surfels(voxels, self._samples, self.evidence.ended_in)
        levels = np.zeros(len(voxels), np.uint8) if record.levels is None else record.levels
        seen_s = np.zeros(len(record.codes), np.int64) if record.seen_s is None else record.seen_s
        return FittedSurfels(
            SurfelCloud(voxels, surfels),
            support_confidence(levels, surfels.kinds),
            np.repeat(seen_s, surface_counts(record.surface)),
        )
