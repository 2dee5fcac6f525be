"""A map as a file has it, answered with numpy alone: slow, and what others must equal.

Positions are float64 in the map frame and become float32 once they are relative to a region's
centre.
"""

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import FormatError
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region

from triquad_map.composition.composed_view import ComposedView
from triquad_map.composition.field_view import field_samples
from triquad_map.composition.region import RecordedRegion, Work
from triquad_map.reference.region_field import RegionField
from triquad_map.reference.seen_blocks import SeenBlocks
from triquad_map.reference.surfel_cloud import fitted_surfels
from triquad_map.view import FieldAnswer

CHUNK_POINTS = 65_536


class MapEvaluator(ComposedView):
    """A :class:`~triquad_map.view.MapView` of a record. For several threads."""

    def __init__(self, record: MapRecord) -> None:
        regions = [_recorded(record.settings, region) for region in record.regions]
        super().__init__(record.epoch, record.settings, regions, split=in_chunks)

    def query(self, points: NDArray[np.floating], gradient: bool = False) -> FieldAnswer:
        """Return signed distance, status and, on request, gradient.

        Args:
            points: ``[N, 3]``, metres, map frame.
            gradient: also give d(sdf)/dx.

        Raises:
            FormatError: ``points`` has another shape, or a coordinate is not finite.
        """
        return super().query(checked_points(points), gradient)


def _recorded(settings: FieldSettings, region: Region) -> RecordedRegion:
    engine, evidence = RegionField(settings, region), SeenBlocks(settings)
    engine.add(region.tables)
    evidence.add(region.evidence)
    field = field_samples(engine, settings, in_chunks)
    return RecordedRegion(
        settings,
        region.index,
        engine=engine,
        evidence=evidence,
        fit=lambda: fitted_surfels(region.evidence, evidence, field),
    )


def in_chunks(count: int, work: Work, least: int = 0) -> None:  # noqa: ARG001
    """Split work to bound memory: a :class:`~triquad_map.composition.region.Split`."""
    for first in range(0, count, CHUNK_POINTS):
        work(first, min(first + CHUNK_POINTS, count))


def checked_points(points: NDArray[np.floating]) -> Doubles:
    """Return points [N, 3] as float64.

    Raises:
        FormatError: ``points`` has another shape, or a coordinate is not finite.
    """
    positions: Doubles = np.asarray(points, np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise FormatError(f"expected points [N, 3], got {list(positions.shape)}")
    finite = np.isfinite(positions).all(axis=1)
    if not finite.all():
        first = int(np.argmin(finite))
        raise FormatError(f"point {first} is not finite: {positions[first].tolist()}")
    return positions
