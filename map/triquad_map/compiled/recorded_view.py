"""A map as a file holds it, answered by compiled code."""

import threading

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region, region_centre

from triquad_map.compiled.compiled_engine import recorded_field
from triquad_map.compiled.compiled_view import CompiledView, field_samples
from triquad_map.compiled.evidence.evidence import Evidence
from triquad_map.compiled.surfels.surfel_map import SurfelMap, SurfelTask, first_surfels
from triquad_map.compiled.team import Team

_QUESTIONS = Team("triquad-questions")


class RecordedRegion:
    """One region; its surfels are fitted when they are first asked for. For several threads."""

    def __init__(self, settings: FieldSettings, region: Region, epoch: int) -> None:
        self.index = region.index
        self.centre: NDArray[np.float64] = region_centre(settings, region.index)
        self.engine = recorded_field(settings, region)
        self.evidence = Evidence.recorded(1 << settings.depth, region.evidence)
        self._settings = settings
        self._epoch = epoch
        self._fitting = threading.Lock()
        self._surfels: SurfelMap | None = None

    @property
    def surfels(self) -> SurfelMap:
        """What stands for its surface; the first who asks waits until all are fitted."""
        if self._surfels is None:
            with self._fitting:
                if self._surfels is None:
                    self._surfels = self._fitted()
        return self._surfels

    def _fitted(self) -> SurfelMap:
        samples = field_samples(self.engine, self._settings, _QUESTIONS.split)
        task = SurfelTask(self._epoch, most=None)
        return first_surfels(self.evidence, samples, task)


def recorded_view(record: MapRecord) -> CompiledView:
    """The map in a record. Questions are split over all cores."""
    regions = [RecordedRegion(record.settings, region, record.epoch) for region in record.regions]
    return CompiledView(record.epoch, record.settings, regions, _QUESTIONS.split)
