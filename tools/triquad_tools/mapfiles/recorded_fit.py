"""The fit of a recorded map to rays that it was not trained on, as a server computes it."""

from contextlib import closing

import numpy as np
from triquad_format.errors import NoCompiledCodeError
from triquad_format.records.arrays import Floats
from triquad_format.records.region import MapRecord, Region
from triquad_format.records.replay_rays import are_held_out
from triquad_map.field_fit import MapFit, PlaceFits, Places, in_cube, map_fit
from triquad_map.record_view import open_view


def recorded_fit(record: MapRecord) -> MapFit | None:
    """Return how well a map fits.

    ``None``: it has no held-out rays, which are training state, or numba is missing.
    """
    ends = {number: _held_out_ends(region, record) for number, region in enumerate(record.regions)}
    ends = {number: points for number, points in ends.items() if len(points)}
    if not ends:
        return None
    try:
        view = open_view(record)
    except NoCompiledCodeError:
        return None
    fits = []
    with closing(view):
        for number, points in ends.items():
            region = view.region_views[number]
            sdf = region.engine.evaluate(points, gradient=False).sdf
            fits.append((region.centre, PlaceFits.of(Places.of(points, record.settings), sdf)))
    return map_fit(fits)


def _held_out_ends(region: Region, record: MapRecord) -> Floats:
    """Return where a region's held-out rays end in its cube [N, 3], metres from its centre."""
    if region.training is None:
        return np.zeros((0, 3), np.float32)
    rays = region.training.rays
    ends = rays.ends_m(record.settings)[are_held_out(rays.ends)].astype(np.float32)
    return ends[in_cube(ends, record.settings)]
