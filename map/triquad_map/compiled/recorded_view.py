"""A map as a file holds it, answered by compiled code."""

import threading

from triquad_format.records.region import MapRecord, Region, region_centre

from triquad_map.compiled.compiled_view import CompiledView
from triquad_map.compiled.evidence.frozen_evidence import FrozenEvidence
from triquad_map.compiled.field.frozen_field import FrozenField
from triquad_map.compiled.surfels.surfel_map import SurfelMap, SurfelTask, first_surfels
from triquad_map.compiled.team import Team
from triquad_map.composition.field_samples import field_samples
from triquad_map.composition.split import Split


class RecordedRegion:
    """One region; its surfels are fitted when they are first asked for. For several threads."""

    def __init__(self, record: MapRecord, region: Region, split: Split) -> None:
        settings = record.settings
        self.index = region.index
        self.centre = region_centre(settings, region.index)
        self.engine = FrozenField.from_record(settings, region)
        self.evidence = FrozenEvidence.from_record(1 << settings.depth, region.evidence)
        self._samples = field_samples(self.engine, settings, split)
        self._task = SurfelTask(record.epoch, most=None)
        self._fitting = threading.Lock()
        self._surfels: SurfelMap | None = None

    @property
    def surfels(self) -> SurfelMap:
        """What stands for its surface; the first who asks waits until all are fitted."""
        with self._fitting:
            if self._surfels is None:
                self._surfels = first_surfels(self.evidence, self._samples, self._task)
            return self._surfels


class RecordedView(CompiledView):
    """The map in a record. Questions are split over all cores, by threads of its own."""

    def __init__(self, record: MapRecord) -> None:
        self._team = Team("triquad-questions")
        regions = [RecordedRegion(record, region, self._team.split) for region in record.regions]
        super().__init__(record.epoch, record.settings, regions, self._team.split)

    def close(self) -> None:
        """End the threads; nothing can be asked any more."""
        self._team.close()
