"""A map as a file has it, answered by compiled code."""

import logging
import threading

from triquad_format.records.region import MapRecord, Region

from triquad_map.compiled.kernel import is_first_use
from triquad_map.compiled.team import Split, Team
from triquad_map.composition.composed_view import ComposedView
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import field_samples, recorded_field
from triquad_map.surfels.surfel_map import SurfelMap, first_surfels

_log = logging.getLogger(__name__)


class RecordedView(ComposedView):
    """The map in a record. Questions are split over all cores, by threads of its own."""

    def __init__(self, record: MapRecord) -> None:
        if is_first_use():
            _log.warning(
                "compiling, at the first questions of each kind; once per machine and release"
            )
        self._team = Team("triquad-questions")
        regions = [RecordedRegion(record, region, self._team.split) for region in record.regions]
        super().__init__(record.epoch, record.settings, regions, split=self._team.split)

    def close(self) -> None:
        """End the threads; later questions are answered on the caller's alone."""
        self._team.close()


class RecordedRegion:
    """A region as a file has it, whose surfels are fitted when they are first asked for."""

    def __init__(self, record: MapRecord, region: Region, split: Split) -> None:
        settings = record.settings
        self.index = region.index
        self.centre = settings.region_centre(region.index)
        self.field = recorded_field(settings, region)
        self.evidence = FrozenEvidence.from_record(1 << settings.depth, region.evidence)
        self._samples = field_samples(self.field, settings, split)
        self._epoch = record.epoch
        self._fitting = threading.Lock()
        self._surfels: SurfelMap | None = None

    @property
    def surfels(self) -> SurfelMap:
        """The surfels of its surface; the first who asks waits until all are fitted."""
        with self._fitting:
            if self._surfels is None:
                self._surfels = first_surfels(self.evidence, self._samples, self._epoch)
            return self._surfels
