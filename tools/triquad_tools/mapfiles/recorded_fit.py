"""The fit of a recorded map to rays that it was not trained on, as a server computes it."""

from contextlib import closing

import numpy as np
from triquad_format.records.region import MapRecord
from triquad_format.records.replay_rays import are_held_out
from triquad_map.field_fit import MapFit, PlaceFits, Places, in_cube, map_fit
from triquad_map.record_view import NoCompiledCodeError, open_view


def recorded_fit(record: MapRecord) -> MapFit | None:
    """Return how well a map fits.

    ``None``: it has no held-out rays, which are training state, or numba is missing.
    """
    settings = record.settings
    try:
        view = open_view(record)
    except NoCompiledCodeError:
        return None
    fits = []
    with closing(view):
        for region, seen in zip(record.regions, view.region_views, strict=True):
            if region.training is None:
                continue
            rays = region.training.rays
            ends = rays.ends_m(settings)[are_held_out(rays.ends)].astype(np.float32)
            ends = ends[in_cube(ends, settings)]
            if len(ends):
                sdf = seen.engine.evaluate(ends, gradient=False).sdf
                fits.append((seen.centre, PlaceFits.of(Places.of(ends, settings), sdf)))
    return map_fit(fits)
