"""A published, immutable state of the map, and the questions it answers."""

from dataclasses import dataclass

from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, RegionIndex
from triquad_map.compiled.evidence.evidence import FrozenEvidence
from triquad_map.compiled.surfels.surfel_map import SurfelMap
from triquad_map.composition.composed_view import ComposedView
from triquad_map.composition.region import Split

from triquad_server.engine.field_record import region_record
from triquad_server.engine.live_field import FrozenField


@dataclass(frozen=True)
class FrozenRegion:
    """A region as it was when it was published."""

    index: RegionIndex
    centre: Doubles  # [3] map frame
    engine: FrozenField
    evidence: FrozenEvidence
    surfels: SurfelMap
    vertices: int
    parameters: int
    changed: int  # epoch of its last change


class Epoch(ComposedView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        name: str,
        number: int,
        settings: FieldSettings,
        regions: tuple[FrozenRegion, ...],
        split: Split,
    ) -> None:
        """The map called ``name``; ``split`` runs the work of its answers."""
        super().__init__(number, settings, regions, split)
        self.frozen_regions = regions
        self._name = name

    @property
    def number(self) -> int:
        """Number of this epoch."""
        return self.epoch

    @property
    def regions(self) -> int:
        """Regions of the map."""
        return len(self.frozen_regions)

    @property
    def field_settings(self) -> FieldSettings:
        """Shape of the field."""
        return self._settings

    @property
    def vertices(self) -> int:
        """Quadtree vertices of all regions."""
        return sum(region.vertices for region in self.frozen_regions)

    @property
    def parameters(self) -> int:
        """Learnable numbers of all regions."""
        return sum(region.parameters for region in self.frozen_regions)

    def record(self) -> MapRecord:
        """The epoch as a map file holds it, without training state."""
        regions = tuple(
            region_record(region.index, region.engine, region.evidence, training=None)
            for region in self.frozen_regions
        )
        return MapRecord(self._name, self.number, self._settings, regions)
