"""A map in compiled code."""

from collections.abc import Sequence
from dataclasses import dataclass

from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex

from triquad_map.compiled.compiled_lattice import CompiledLattice
from triquad_map.compiled.evidence.frozen_evidence import FrozenEvidence
from triquad_map.compiled.surfels.surfel_map import SurfelMap
from triquad_map.composition.composed_view import ComposedView
from triquad_map.composition.region import FieldEngine, MapRegion
from triquad_map.composition.split import Split, in_one


@dataclass(frozen=True)
class RegionView:
    """A region of which all is there."""

    index: RegionIndex
    centre: Doubles  # [3] map frame
    engine: FieldEngine
    evidence: FrozenEvidence
    surfels: SurfelMap


class CompiledView(ComposedView):
    """An immutable map of regions that answer in compiled code. For any thread."""

    def __init__(
        self,
        epoch: int,
        settings: FieldSettings,
        regions: Sequence[MapRegion],
        split: Split = in_one,
    ) -> None:
        """``split`` shares the work of a question among threads."""
        lattice = CompiledLattice(settings, [region.index for region in regions])
        super().__init__(epoch, settings, regions, lattice, split)
