"""The rays of a replay pool as a record holds them, and back."""

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.replay_rays import SLOPE_SCALE, STEPS, ReplayRays

from triquad_server.mapping.held_out import ends_in_steps
from triquad_server.mapping.ray_table import VALUE, RayTable

_MOST_RAYS = 6_000_000  # so many fit into the parts of a single cube

_ORIGIN_BITS = 15  # beside 48 of a leaf's code


def recorded_rays(table: RayTable, settings: FieldSettings, most: int) -> tuple[ReplayRays, Longs]:
    """The rays of a table, ``most`` of them, and the places of all else in it: samples, and what
    ends far away.
    """
    side = 1 << settings.depth
    steps = ends_in_steps(table.rows, settings)
    fits = (table.origin_of >= 0) & ((steps >= 0) & (steps < 2 * side * STEPS)).all(axis=1)
    places = np.flatnonzero(fits)
    most = min(most, _MOST_RAYS)
    if len(places) > most:
        places = np.sort(np.random.default_rng(len(places)).choice(places, most, False))
    # By origin within a leaf, nearly: neighbours that are alike take less room.
    coarser = max(0, len(table.origins).bit_length() - _ORIGIN_BITS)
    codes = morton.encode(steps[places] // STEPS) << _ORIGIN_BITS
    places = places[np.argsort(codes | table.origin_of[places] >> coarser)]
    slopes = np.rint(SLOPE_SCALE * np.abs(table.rows[places, VALUE]))
    rays = ReplayRays(
        steps[places].astype(np.int32),
        table.origin_of[places],
        slopes.astype(np.uint8),
        origins=table.origins,
    )
    return rays.chosen(np.arange(len(rays))), np.flatnonzero(~fits)


def restored_rays(rays: ReplayRays, settings: FieldSettings) -> RayTable:
    """The rays of a record."""
    slopes = rays.slopes / SLOPE_SCALE
    slopes[rays.slopes == SLOPE_SCALE] = -1.0  # which may be since nothing told it
    rows = np.column_stack([rays.ends_m(settings), slopes]).astype(np.float32)
    return RayTable(rows, rays.origin_of, rays.origins)
