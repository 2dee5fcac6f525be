"""A map as a file has it, answered by compiled code."""

import logging

from triquad_format.records.region import MapRecord, Region

from triquad_map.compiled.evidence.evidence import FrozenEvidence
from triquad_map.compiled.field.frozen_field import recorded_field
from triquad_map.compiled.kernel import is_first_use
from triquad_map.compiled.surfels.surfel_map import SurfelMap, first_surfels
from triquad_map.compiled.team import Team
from triquad_map.composition.composed_view import ComposedView
from triquad_map.composition.field_view import field_samples
from triquad_map.composition.region import RecordedRegion, Split

_log = logging.getLogger(__name__)


class RecordedView(ComposedView):
    """The map in a record. Questions are split over all cores, by threads of its own."""

    def __init__(self, record: MapRecord) -> None:
        if is_first_use():
            _log.warning(
                "compiling, at the first questions of each kind; once per machine and release"
            )
        self._team = Team("triquad-questions")
        regions = [_recorded(record, region, self._team.split) for region in record.regions]
        super().__init__(record.epoch, record.settings, regions, split=self._team.split)

    def close(self) -> None:
        """End the threads; later questions are answered on the caller's alone."""
        self._team.close()


def _recorded(record: MapRecord, region: Region, split: Split) -> RecordedRegion:
    settings = record.settings
    engine = recorded_field(settings, region)
    evidence = FrozenEvidence.from_record(1 << settings.depth, region.evidence)
    samples = field_samples(engine, settings, split)

    def fit() -> SurfelMap:
        return first_surfels(evidence, samples, record.epoch)

    return RecordedRegion(settings, region.index, engine=engine, evidence=evidence, fit=fit)
