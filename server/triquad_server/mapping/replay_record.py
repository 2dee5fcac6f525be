"""The rays of a replay pool as a record holds them, and back.

The file tells where rays end more finely than any sensor does, and at which angle they met the
surface. Rounded ends take less room there, and angles that the ends around tell again take none: so
there is room for more rays.
"""

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Floats, Ints, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.replay_rays import SLOPE_SCALE, STEPS, ReplayRays, are_held_out
from triquad_map.compiled.team import Team

from triquad_server.mapping.held_out import ends_in_steps
from triquad_server.mapping.normals import SurfaceNormals
from triquad_server.mapping.ray_table import LEAST_SLOPE, VALUE, RayTable

_MOST_RAYS = 6_000_000  # so many fit into the parts of a single cube

_ORIGIN_BITS = 15  # beside 48 of a leaf's code

_ROUNDED_STEPS = 3
"""To the middle of so many steps: 5 mm at the default leaf, which adds 1.4 mm of noise."""

_FIRST = np.arange(STEPS, dtype=np.int32) // _ROUNDED_STEPS * _ROUNDED_STEPS
_ROUNDED = (_FIRST + np.minimum(_FIRST + _ROUNDED_STEPS, STEPS) - 1) // 2  # of each step of a leaf

_ROUNDED_SLOPES = 8  # of SLOPE_SCALE


def recorded_rays(table: RayTable, settings: FieldSettings) -> tuple[ReplayRays, Longs]:
    """The rays of a table, as many as a file holds, and the places of all else in it: samples, and
    what ends far away.
    """
    side = 1 << settings.depth
    steps = ends_in_steps(table.rows, settings)
    fits = (table.origin_of >= 0) & ((steps >= 0) & (steps < 2 * side * STEPS)).all(axis=1)
    places = np.flatnonzero(fits)
    if len(places) > _MOST_RAYS:
        places = np.sort(np.random.default_rng(len(places)).choice(places, _MOST_RAYS, False))
    # By origin within a leaf, nearly: neighbours that are alike take less room.
    coarser = max(0, len(table.origins).bit_length() - _ORIGIN_BITS)
    codes = morton.encode(steps[places] // STEPS) << _ORIGIN_BITS
    places = places[np.argsort(codes | table.origin_of[places] >> coarser)]
    rays = ReplayRays(
        _rounded_ends(steps[places].astype(np.int32)),
        table.origin_of[places],
        _told_slopes(table.rows[places, VALUE]),
        origins=table.origins,
    )
    return rays.chosen(np.arange(len(rays))), np.flatnonzero(~fits)


def _rounded_ends(steps: Ints) -> Ints:
    """Ends [N, 3] within the same leaves; rays that are held out stay what they are, and no others
    become it.
    """
    rounded = steps - steps % STEPS + _ROUNDED[steps % STEPS]
    is_exact = are_held_out(steps) | are_held_out(rounded)
    rounded[is_exact] = steps[is_exact]
    return rounded


def _told_slopes(values: Floats) -> Bytes:
    """Slopes [N] of rays with these ``values`` [N] in their table, if the field told them.

    SLOPE_SCALE where a normal did, and where nothing did.
    """
    slopes = (SLOPE_SCALE * np.abs(values)).astype(np.uint8)
    rounded = slopes - slopes % _ROUNDED_SLOPES + _ROUNDED_SLOPES // 2
    is_told = (values < 0) & (values > -1)
    return np.where(is_told, rounded, SLOPE_SCALE).astype(np.uint8)


def restored_rays(rays: ReplayRays, settings: FieldSettings, team: Team) -> RayTable:
    """The rays of a record; their slopes are told by the ends around, where these have a normal."""
    ends = rays.ends_m(settings)
    normals = SurfaceNormals(settings.leaf_m, team, max_cells=len(ends)).add(ends, np.zeros(3))
    ways = ends - rays.origins[rays.origin_of]
    cosines = (ways * normals).sum(axis=1) / np.maximum(np.linalg.norm(ways, axis=1), 1e-9)
    slopes = np.maximum(np.abs(cosines), LEAST_SLOPE)
    is_unsure = np.isnan(slopes)
    slopes[is_unsure] = -rays.slopes[is_unsure].astype(np.float64) / SLOPE_SCALE
    rows = np.column_stack([ends, slopes]).astype(np.float32)
    return RayTable(rows, rays.origin_of, rays.origins)
