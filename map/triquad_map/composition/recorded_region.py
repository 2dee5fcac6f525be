"""A region as a file holds it, whose surfels are fitted when they are first asked for."""

import threading
from collections.abc import Callable

from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex, region_centre

from triquad_map.composition.region import FieldEngine, RegionSurfels, SeenSpace


class RecordedRegion:
    """A :class:`~triquad_map.composition.region.MapRegion`. For several threads."""

    def __init__(
        self,
        settings: FieldSettings,
        index: RegionIndex,
        engine: FieldEngine,
        evidence: SeenSpace,
        fit: Callable[[], RegionSurfels],
    ) -> None:
        """``fit`` makes the surfels, which takes a while; it is called once at most."""
        self.index = index
        self.centre = region_centre(settings, index)
        self.engine = engine
        self.evidence = evidence
        self._fit = fit
        self._fitting = threading.Lock()
        self._surfels: RegionSurfels | None = None

    @property
    def surfels(self) -> RegionSurfels:
        """What stands for its surface; the first who asks waits until all are fitted."""
        with self._fitting:
            if self._surfels is None:
                self._surfels = self._fit()
            return self._surfels
