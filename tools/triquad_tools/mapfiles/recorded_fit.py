"""The fit of a recorded map to rays that it was not trained on, as a server computes it."""

import numpy as np
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region
from triquad_format.records.replay_rays import are_held_out
from triquad_map.field_fit import MapFit, PlaceFits, map_fit
from triquad_map.places import Places, in_cube
from triquad_map.reference.evaluator import in_chunks
from triquad_map.reference.region_field import RegionField


def recorded_fit(record: MapRecord) -> MapFit | None:
    """Return how well a map fits; ``None`` if it has no held-out rays, which are training state."""
    settings = record.settings
    fits = []
    for region in record.regions:
        if region.training is None:
            continue
        rays = region.training.rays
        ends = rays.ends_m(settings)[are_held_out(rays.ends)].astype(np.float32)
        ends = ends[in_cube(ends, settings)]
        if len(ends):
            fit = PlaceFits.of(Places.of(ends, settings), _field(region, settings, ends))
            fits.append((settings.region_centre(region.index), fit))
    return map_fit(fits)


def _field(region: Region, settings: FieldSettings, points: Floats) -> Floats:
    """Return the field of a region at points [N, 3], metres from its centre."""
    field = RegionField(settings, region)
    field.add(region.tables)
    sdf = np.empty(len(points), np.float32)

    def work(first: int, last: int) -> None:
        sdf[first:last] = field.evaluate(points[first:last], gradient=False).sdf

    with np.errstate(all="ignore"):  # a field that overflows fits badly, and that is reported
        in_chunks(len(points), work)
    return sdf
