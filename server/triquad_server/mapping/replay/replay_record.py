"""Converts kept rays to their form in a record, and back; which are held out follows from it.

The file holds ends of rays more finely than any sensor measures, and the angle of incidence at
the surface. Rounded ends take less room there, and angles implied by the ends around take none: so
there is room for more rays.
"""

import numpy as np
from triquad_format.records import morton, replay_rays
from triquad_format.records.arrays import Bools, Bytes, Floats, Ints, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.replay_rays import SLOPE_SCALE, STEPS, ReplayRays
from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.team import Team
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting
from triquad_map.evidence.ray_surfels import normals_at

from triquad_server.mapping.replay.ray_table import COLUMNS, END, LEAST_SLOPE, VALUE, RayTable

_MOST_RAYS = 6_000_000  # this many fit into the parts of a single cube

_ORIGIN_BITS = 15  # in addition to 48 of a leaf's code

_ROUNDED_STEPS = 3
"""Ends are rounded to the middle of this many steps: 5 mm at the default leaf, which adds 1.4 mm
of noise."""

_ROUNDED_SLOPES = 8  # of SLOPE_SCALE

_AT_ONCE = 1 << 14  # rays, which fit into the cache: a quarter of the time that all together take

_FAR = -1  # the code of what is no ray that ends in the cube


@kernel(inline="always")
def end_in_steps(row: Floats, leaf_m: float, corner: float) -> tuple[int, int, int]:
    """Return where a ray of a table ends, as in
    :class:`triquad_format.records.replay_rays.ReplayRays`; the cube's ``corner`` is that many
    leaves away.
    """
    return (
        np.int64(np.floor((np.float64(row[END]) / leaf_m + corner) * STEPS)),
        np.int64(np.floor((np.float64(row[END + 1]) / leaf_m + corner) * STEPS)),
        np.int64(np.floor((np.float64(row[END + 2]) / leaf_m + corner) * STEPS)),
    )


@inner_kernel()
def is_held_out(x: int, y: int, z: int) -> bool:
    """Return :func:`triquad_format.records.replay_rays.are_held_out` of one ray."""
    key = np.uint64(0)
    for step in (x, y, z):
        key = key << np.uint64(replay_rays.AXIS_BITS) | np.uint64(step & replay_rays.AXIS_MASK)
    held: bool = (key * replay_rays.MIXED) >> np.uint64(replay_rays.MIXED_SHIFT) == 0
    return held


@kernel()
def _held_out(rows: Floats, leaf_m: float, corner: float) -> Bools:
    held = np.empty(len(rows), np.bool_)
    for i in range(len(rows)):
        x, y, z = end_in_steps(rows[i], leaf_m, corner)
        held[i] = is_held_out(x, y, z)
    return held


def are_held_out(rows: Floats, settings: FieldSettings) -> Bools:
    """Return which rays are held out."""
    return _held_out(rows, settings.leaf_m, float(1 << settings.depth))


@inner_kernel()
def _leaf_code(x: int, y: int, z: int) -> int:
    """Return :func:`triquad_format.records.morton.encode` of one leaf."""
    code: int = np.int64(0)
    for axis, number in enumerate((x, y, z)):
        bits = np.int64(number)
        for shift, mask in morton.SPREAD_3D:
            bits = (bits | (bits << shift)) & mask
        code |= bits << axis
    return code


@kernel()
def _codes(table: RayTable, leaf_m: float, side: int, coarser: int) -> Longs:
    """Return codes that sort a table's rays [N]: by origin within a leaf, nearly.

    Similar neighbours take less room.
    """
    codes = np.empty(len(table.rows), np.int64)
    most = 2 * side * STEPS
    for i in range(len(codes)):
        x, y, z = end_in_steps(table.rows[i], leaf_m, float(side))
        origin = np.int64(table.origin_of[i])
        codes[i] = _FAR
        if origin >= 0 and min(x, y, z) >= 0 and max(x, y, z) < most:
            code = _leaf_code(x // STEPS, y // STEPS, z // STEPS)
            codes[i] = code << _ORIGIN_BITS | origin >> coarser
    return codes


@kernel()
def _record(
    rows: Floats, places: Longs, leaf_m: float, corner: float, ends: Ints, slopes: Bytes
) -> None:
    """Fill in the ``ends`` [R, 3] and ``slopes`` [R] of the rays at ``places`` [R]."""
    for i in range(len(places)):
        row = rows[places[i]]
        x, y, z = end_in_steps(row, leaf_m, corner)
        near_x, near_y, near_z = _rounded(x), _rounded(y), _rounded(z)
        # Rays that are held out remain so, and no others become held out.
        if not is_held_out(x, y, z) and not is_held_out(near_x, near_y, near_z):
            x, y, z = near_x, near_y, near_z
        ends[i, 0], ends[i, 1], ends[i, 2] = x, y, z
        slopes[i] = _told_slope(row[VALUE])


@inner_kernel()
def _rounded(step: int) -> int:
    """Return the middle of a few steps of the same leaf."""
    leaf = step // STEPS * STEPS
    first = (step - leaf) // _ROUNDED_STEPS * _ROUNDED_STEPS
    after = min(first + _ROUNDED_STEPS, STEPS)
    return leaf + (first + after - 1) // 2


@inner_kernel()
def _told_slope(value: float) -> int:
    """Return the slope of a ray with this ``value`` in its table, if the field gave it.

    It is SLOPE_SCALE where a normal gave it, or nothing did.
    """
    if value >= 0 or value <= -1:
        return SLOPE_SCALE
    return int(-SLOPE_SCALE * value) // _ROUNDED_SLOPES * _ROUNDED_SLOPES + _ROUNDED_SLOPES // 2


def recorded_rays(table: RayTable, settings: FieldSettings) -> tuple[ReplayRays, Longs]:
    """Return the rays of a table, as many as a file holds, and the places of all else in it:
    samples, and what ends far away.
    """
    side = 1 << settings.depth
    coarser = max(0, len(table.origins).bit_length() - _ORIGIN_BITS)
    codes = _codes(table, settings.leaf_m, side, coarser)
    places = np.argsort(codes)
    far = int((codes == _FAR).sum())
    del codes  # for a big map's rays, memory is shortest
    others, places = np.sort(places[:far]), places[far:]
    if len(places) > _MOST_RAYS:
        rng = np.random.default_rng(len(places))
        places = places[np.sort(rng.choice(len(places), _MOST_RAYS, replace=False))]
    ends, slopes = np.empty((len(places), 3), np.int32), np.empty(len(places), np.uint8)
    _record(table.rows, places, settings.leaf_m, float(side), ends, slopes)
    rays = ReplayRays(ends, table.origin_of[places], slopes, origins=table.origins)
    return rays.with_own_origins(), others


def restored_rays(rays: ReplayRays, settings: FieldSettings, team: Team) -> RayTable:
    """Return the rays of a record; their slopes follow from normals of the ends around, if any."""
    ends = rays.ends_m(settings)
    voxels = settings.leaf_coordinates(ends)
    evidence = LiveEvidence(1 << settings.depth)
    sighting = Sighting(np.zeros(3), settings.leaf_m, stamp_s=0, scan=1)
    places = evidence.add_ends(voxels, sighting)
    search = evidence.outdated_normals(places, sighting.unlearnt_since)
    team.split(len(search.rows), search.find)
    search.finish()
    rows = np.empty((len(rays), COLUMNS), np.float32)
    for first in range(0, len(rays), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        normals = normals_at(voxels[some], places[some], evidence.observed)
        ways = ends[some] - rays.origins[rays.origin_of[some]]
        cosines = (ways * normals).sum(axis=1) / np.maximum(np.linalg.norm(ways, axis=1), 1e-9)
        told = -rays.slopes[some].astype(np.float64) / SLOPE_SCALE
        slopes = np.where(np.isnan(cosines), told, np.maximum(np.abs(cosines), LEAST_SLOPE))
        rows[some, END : END + 3], rows[some, VALUE] = ends[some], slopes
    return RayTable(rows, rays.origin_of, rays.origins)
