"""Rays that end: each adds to the record of the voxel in which it does.

Kernels stop where there is no more room; the caller makes room and goes on. Files have no ends: in
evidence that was restored, discs of the field take their place.
"""

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import (
    LOW,
    SHIFT,
    bit_of,
    block_key,
    byte_of,
    is_inside,
    make_row,
)
from triquad_map.evidence.observed import (
    EIGHTHS,
    FILLED,
    MOST_SCANS,
    MOST_SEEN,
    PRIOR_ENDS,
    Observed,
    ObservedVoxel,
    Sighting,
    Vector,
    Voxel,
    forget_ends,
    is_flat,
    row_of,
    rows_around,
    voxel_of,
)
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.surface import NEAR_M, SurfelKind

COUNTED_ENDS = 64
"""The ends of a voxel that count; the shape that further ones give counts as that of as many."""

_DISC = int(SurfelKind.DISC)


@kernel(inline="always")
def _sector(x: float, y: float) -> int:
    """Return which eighth of the horizon a direction lies in."""
    eighth = 0 if y >= 0 else 4
    if (x >= 0) != (y >= 0):
        eighth += 2
    return eighth + (1 if abs(y) > abs(x) else 0)


@kernel(inline="always")
def _add_ray(voxel: ObservedVoxel, end: Vector, sighting: Sighting) -> None:
    """Count a ray that ended at ``end``, voxels, by how far and where the sensor was."""
    origin, towards = sighting.origin, voxel.towards
    dx, dy, dz = origin[0] - end[0], origin[1] - end[1], origin[2] - end[2]
    towards[0], towards[1], towards[2] = dx, dy, dz
    square = (dx * dx + dy * dy + dz * dz) * (sighting.leaf_m / NEAR_M) ** 2
    voxel.weight += np.float32(1 / (1 + square))
    voxel.sectors |= 1 << _sector(dx, dy)


@kernel(inline="always")
def _begin_hit(voxel: ObservedVoxel, scan: int) -> None:
    """Count a scan of which a ray ended in a voxel: what passed before goes to its record."""
    if voxel.hit_scan == scan:
        voxel.ended += 1
        return
    voxel.hit_scan = scan
    voxel.ended, voxel.crossed = 1, 0
    voxel.scans = min(voxel.scans + 1, MOST_SCANS)
    if voxel.ends > 0:  # else they passed while nothing was there
        voxel.earlier_misses += voxel.misses
    else:
        voxel.first_scan = scan
        voxel.hits = voxel.earlier_misses = 0
    voxel.misses = 0
    voxel.hits += 1
    share = MOST_SEEN / max(np.float32(MOST_SEEN), voxel.hits + voxel.earlier_misses)
    voxel.hits *= share
    voxel.earlier_misses *= share


@kernel(inline="always")
def _add_end(voxel: ObservedVoxel, end: Vector) -> None:
    """Move the shape of the surface in a voxel by a ray that ended at a place in it."""
    mean, normal = voxel.mean, voxel.normal
    count = min(voxel.ends + np.float32(1), np.float32(COUNTED_ENDS))
    if count == 1:
        for axis in range(3):
            mean[axis], normal[axis] = end[axis], 0
        voxel.spread[:] = 0
    voxel.ends = count
    x, y, z = end[0] - mean[0], end[1] - mean[1], end[2] - mean[2]
    for axis in range(3):
        eighth = int(EIGHTHS * end[axis])
        voxel.lowest[axis] = min(voxel.lowest[axis], eighth)
        voxel.highest[axis] = max(voxel.highest[axis], eighth)
        mean[axis] += np.float32(end[axis] - mean[axis]) / count
    share = np.float32(1 - 1 / count)  # from the old mean to the new one
    spread = voxel.spread
    spread[0] += (np.float32(x * x) * share - spread[0]) / count
    spread[1] += (np.float32(x * y) * share - spread[1]) / count
    spread[2] += (np.float32(x * z) * share - spread[2]) / count
    spread[3] += (np.float32(y * y) * share - spread[3]) / count
    spread[4] += (np.float32(y * z) * share - spread[4]) / count
    spread[5] += (np.float32(z * z) * share - spread[5]) / count


@kernel()
def extend_new(rows: Ints, extents: Doubles, scan: int, observed: Observed) -> None:
    """Let the surface extend in the voxels of ``rows`` [N], where it was first hit in a scan.

    ``extents`` [N, 6] are covariances, square voxels. Until there are more ends, they are all that
    tells its shape: they count as much as :data:`PRIOR_ENDS` and the first one.
    """
    for i, row in enumerate(rows):
        voxel = observed.voxels[row]
        if voxel.first_scan == scan:
            share = (PRIOR_ENDS + 1) / (voxel.ends * voxel.ended)  # all its rays of the scan add
            for axis in range(6):
                voxel.spread[axis] += np.float32(share * extents[i, axis])


@kernel(inline="always")
def _add(known: ObservedVoxel, end: Vector, corner: Voxel, sighting: Sighting) -> None:
    """Count a ray that ended at ``end``, in the voxel with this ``corner``."""
    _add_ray(known, end, sighting)
    _begin_hit(known, sighting.scan)
    _add_end(known, (end[0] - corner[0], end[1] - corner[1], end[2] - corner[2]))


@kernel(inline="always")
def _begin_voxel(row: int, block: int, voxel: int, observed: Observed) -> None:
    """Let a voxel of a block have the row, in which nothing is recorded."""
    place = observed.places[block]
    observed.rows[place, voxel] = row
    observed.ended[place, voxel >> SHIFT] |= bit_of(voxel & LOW)
    observed.voxels[row].owner = block << (3 * SHIFT) | voxel
    forget_ends(observed.voxels[row])


@kernel()
def record_ends(
    voxels: Doubles,
    start: int,
    seen: SeenVoxels,
    blocks: int,
    sighting: Sighting,
    observed: Observed,
    places: int,
    rows: int,
    found: Ints,
) -> tuple[int, int, int, int]:
    """Count rays that ended at ``voxels`` [N, 3].

    The row of each ray's voxel goes to ``found`` [N]; 0 outside the region. Returns (points done,
    blocks, places, rows in use); where there is no more room, not all points are done.
    """
    for i in range(start, len(voxels)):
        end = (voxels[i, 0], voxels[i, 1], voxels[i, 2])
        x, y, z = int(np.floor(end[0])), int(np.floor(end[1])), int(np.floor(end[2]))
        found[i] = 0
        if not is_inside(x, y, z, seen.side):
            continue
        block = make_row(seen.blocks, blocks, block_key(x, y, z))
        if block < 0:
            return i, blocks, places, rows
        blocks = max(blocks, block + 1)
        place = observed.places[block]
        if place == 0:
            if places == len(observed.seen_s):
                return i, blocks, places, rows
            place = observed.places[block] = places
            places += 1
        voxel = byte_of(x, y) << SHIFT | (z & LOW)
        row = observed.rows[place, voxel]
        if row == 0:
            if rows == len(observed.voxels):
                return i, blocks, places, rows
            row = rows
            _begin_voxel(row, block, voxel, observed)
            rows += 1
        found[i] = row
        observed.seen_s[place] = max(observed.seen_s[place], sighting.stamp_s)
        _add(observed.voxels[row], end, (x, y, z), sighting)
    return len(voxels), blocks, places, rows


@kernel()
def set_discs(
    voxels: Longs,
    offsets: Floats,
    normals: Floats,
    kinds: Bytes,
    seen: SeenVoxels,
    observed: Observed,
) -> None:
    """Take the discs of surfels as the ends in ``voxels`` [N, 3] of which no ray has shown any."""
    for i in range(len(voxels)):
        row = row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])
        voxel = observed.voxels[row]
        if row == 0 or voxel.ends != 0:  # rays have shown since
            continue
        is_disc = kinds[i] == _DISC
        for axis in range(3):
            voxel.mean[axis] = offsets[i, axis] + 0.5 if is_disc else np.nan
            voxel.normal[axis] = normals[i, axis] if is_disc else 0.0
        _set_spread(voxel, FILLED)
        voxel.ends = COUNTED_ENDS if is_disc else 0
    for i in range(len(voxels)):
        row = row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])
        if row != 0 and observed.voxels[row].ends == 0:
            _set_disc_beside(row, seen, observed)


@inner_kernel()
def _set_spread(voxel: ObservedVoxel, variance: float) -> None:
    """Let the ends of a voxel lie in the plane of its normal, with a variance on each axis."""
    x, y, z = voxel.normal
    voxel.spread[0], voxel.spread[1], voxel.spread[2] = 1 - x * x, -x * y, -x * z
    voxel.spread[3], voxel.spread[4], voxel.spread[5] = 1 - y * y, -y * z, 1 - z * z
    voxel.spread *= np.float32(variance)


@inner_kernel()
def _set_disc_beside(row: int, seen: SeenVoxels, observed: Observed) -> None:
    """Take the disc of a voxel next to it for one that has none: the nearest to its middle.

    The ends of noisy rays lie in voxels on both sides of a surface, and the disc in one of them.
    """
    voxel, corner = observed.voxels[row], voxel_of(row, seen, observed)
    nearest = np.inf
    for near in rows_around(row, 1, seen, observed):
        disc = observed.voxels[near]
        normal, mean = disc.normal, disc.mean
        if near == row or not is_flat(disc):
            continue
        beside = voxel_of(np.int64(near), seen, observed)
        height = 0.0
        for axis in range(3):
            height += (corner[axis] + 0.5 - beside[axis] - mean[axis]) * normal[axis]
        is_there = abs(height) < nearest
        for axis in range(3):
            foot = corner[axis] + 0.5 - height * normal[axis] - beside[axis]
            is_there = is_there and 0 <= foot <= 1
        if is_there:
            nearest = abs(height)
            for axis in range(3):
                voxel.mean[axis] = 0.5 - height * normal[axis]
                voxel.normal[axis] = normal[axis]
            voxel.ends = COUNTED_ENDS
