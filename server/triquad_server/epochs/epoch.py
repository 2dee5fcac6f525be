"""A published state of the map, and what it answers."""

from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass

from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.map_progress import MapProgress
from triquad_format.records.region import MapRecord, Region
from triquad_map.compiled.team import Split, in_one
from triquad_map.composition.composed_view import ComposedView
from triquad_map.composition.shown_field import ShownField
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import FrozenField
from triquad_map.surfels.surfel_map import SurfelMap

from triquad_server.engine.field_record import region_record
from triquad_server.epochs.array_memory import Buffers


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
    live_bytes: Mapping[str, int]  # by part, memory of the live region in addition to this one
    buffers: Buffers  # memory of this one; other epochs may share it

    @property
    def field(self) -> ShownField:
        """The field as it is shown while it is trained."""
        return ShownField(self.engine, self.surfels)

    def record(self) -> Region:
        """Return the region as a map file holds it, without training state."""
        return region_record(self.index, self.engine, self.evidence, training=None)


class Epoch(ComposedView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        name: str,
        number: int,
        settings: FieldSettings,
        regions: tuple[FrozenRegion, ...],
        split: Split,
        progress: MapProgress | None = None,
    ) -> None:
        """Make an epoch of the map called ``name``; ``split`` runs the work of its answers.

        ``progress`` is how far the map had come; ``None``: it was just begun.
        """
        super().__init__(number, settings, regions, split=split)
        self.number = number
        self.field_settings = settings
        self.frozen_regions = regions
        self.progress = progress or MapProgress()
        self._name = name

    def with_split(self, split: Split = in_one) -> ComposedView:
        """Return the same map, whose answers ``split`` runs: by default, the caller's thread alone.

        It is for callers that give way to queries, which have threads of their own.
        """
        return ComposedView(self.number, self.field_settings, self.frozen_regions, split=split)

    @property
    def regions(self) -> int:
        """The number of regions of the map."""
        return len(self.frozen_regions)

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

    def record(self) -> MapRecord:
        """Return the epoch as a map file holds it, without training state."""
        regions = tuple(region.record() for region in self.frozen_regions)
        return MapRecord(
            self._name, self.number, self.field_settings, regions, progress=self.progress
        )
