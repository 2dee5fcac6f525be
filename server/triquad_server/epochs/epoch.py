"""A published state of the map."""

from collections import ChainMap
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import MapProgress, MapRecord, Region
from triquad_map.compiled.team import Split, in_one
from triquad_map.composition.composed_view import ComposedView
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import FrozenField
from triquad_map.surfels.ray_planes import ShownField
from triquad_map.surfels.surfel_map import SurfelMap

from triquad_server.engine.field_record import region_record
from triquad_server.epochs.buffers import Buffers
from triquad_server.epochs.cold_region import ColdRegion

_NO_ORIGIN = np.zeros(3)


@dataclass(frozen=True)
class FrozenRegion:
    """A region as it was when it was published."""

    index: RegionIndex
    centre: Doubles  # [3] map frame
    engine: FrozenField
    evidence: FrozenEvidence
    surfels: SurfelMap
    changed: int  # epoch of its last change
    buffers: Buffers  # memory of this one; other epochs may share it

    @property
    def field(self) -> ShownField:
        """The field as it is shown while it is trained."""
        return ShownField(self.engine, self.surfels.planes)

    @property
    def newest_s(self) -> int:
        """When a ray last ended anywhere in it, seconds since 1970; 0: never, or not known."""
        return self.evidence.newest_s

    def read_evidence(self) -> FrozenEvidence:
        """Return the space that rays have shown of it: there is nothing to read."""
        return self.evidence

    def surfels_between(self, _low: Doubles, _high: Doubles) -> tuple[SurfelMap]:
        """Return all its surfels."""
        return (self.surfels,)

    @property
    def vertices(self) -> int:
        """The number of quadtree vertices, on all planes and levels."""
        return len(self.engine.arrays.features) - 1  # the first row is of absent vertices

    @property
    def parameters(self) -> int:
        """The number of learnable numbers."""
        features, mlp, _ = self.engine.arrays
        return int(features[1:].size + sum(part.size for part in mlp))

    def record(self) -> Region:
        """Return the region as a map file holds it, without training state."""
        return region_record(self.index, self.engine, self.evidence)


EpochRegion = FrozenRegion | ColdRegion
"""A region of an epoch: as it was published, or as its checkpoint has it."""


class Epoch(ComposedView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        name: str,
        number: int,
        settings: FieldSettings,
        regions: tuple[EpochRegion, ...],
        split: Split,
        progress: MapProgress | None = None,
        origin: Doubles = _NO_ORIGIN,
    ) -> None:
        """Make an epoch of the map called ``name``; ``split`` runs the work of its answers.

        ``progress`` is how far the map had come; ``None``: it was just begun. ``origin`` [3] is
        from where it counts, in the user's coordinates: 0 0 0 until the first scan chooses it,
        from then on another object, the same in all epochs.
        """
        super().__init__(number, settings, regions, split=split)
        self.number = number
        self.field_settings = settings
        self.frozen_regions = regions
        self.progress = progress or MapProgress()
        self.origin = origin
        self._name = name

    def in_one_thread(self) -> ComposedView:
        """Return the same map, whose answers the caller's thread finds alone.

        It is for callers that give way to queries, which have threads of their own.
        """
        return ComposedView(self.number, self.field_settings, self.frozen_regions, split=in_one)

    @property
    def regions(self) -> int:
        """The number of regions of the map."""
        return len(self.frozen_regions)

    @property
    def cold_regions(self) -> int:
        """The number of those that are not in memory."""
        return sum(isinstance(region, ColdRegion) for region in self.frozen_regions)

    @property
    def vertices(self) -> int:
        """The number of quadtree vertices of all regions."""
        return sum(region.vertices for region in self.frozen_regions)

    @property
    def parameters(self) -> int:
        """The number of learnable numbers of all regions."""
        return sum(region.parameters for region in self.frozen_regions)

    @property
    def buffers(self) -> Buffers:
        """The memory of the epoch; epochs share that of what did not change between them."""
        return ChainMap(*(dict(region.buffers) for region in self.frozen_regions))

    def record(self, regions: tuple[Region, ...] | None = None) -> MapRecord:
        """Return the epoch as a map file holds it, with these ``regions`` of it.

        ``None``: all regions, without training state.
        """
        if regions is None:
            regions = tuple(region.record() for region in self.frozen_regions)
        x, y, z = self.origin.tolist()
        return MapRecord(
            self._name, self.number, self.field_settings, regions, self.progress, (x, y, z)
        )
