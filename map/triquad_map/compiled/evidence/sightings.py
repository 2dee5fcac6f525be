"""The counts of a scan's rays that end, each in its voxel.

Kernels stop where there is no more room; the caller makes room and goes on.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Ints

from triquad_map.compiled.evidence.observed import (
    EIGHTHS,
    MOST_SCANS,
    Observed,
    ObservedVoxel,
    Vector,
    forget_ends,
)
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, byte_of, find_block
from triquad_map.surface import NEAR_M

_COUNTED_ENDS = 64
"""The ends of a voxel that count; the shape that further ones give counts as that of as many."""


class Sighting(NamedTuple):
    """The place and the time of a scan."""

    origin: Doubles  # [3] the sensor, voxels
    leaf_m: float
    stamp_s: int  # seconds since 1970
    scan: int  # its number, from 1 on; that of the next is greater


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
        return
    voxel.hit_scan = scan
    voxel.hits += 1
    voxel.scans = min(voxel.scans + 1, MOST_SCANS)
    if voxel.ends > 0:  # else they passed while nothing was there
        voxel.earlier_passes += voxel.passes
        voxel.earlier_misses += voxel.misses
    else:
        voxel.first_scan = scan
    voxel.pass_scans = voxel.passes = voxel.misses = 0


@kernel(inline="always")
def _add_end(voxel: ObservedVoxel, end: Vector) -> None:
    """Move the shape of the surface in a voxel by a ray that ended at a place in it."""
    mean, normal = voxel.mean, voxel.normal
    count = min(voxel.ends + np.float32(1), np.float32(_COUNTED_ENDS))
    if count == 1:
        for axis in range(3):
            mean[axis], normal[axis] = end[axis], 0
        voxel.spread = 0
    voxel.ends = count
    squared = np.float32(0)
    for axis in range(3):
        eighth = int(EIGHTHS * end[axis])
        voxel.lowest[axis] = min(voxel.lowest[axis], eighth)
        voxel.highest[axis] = max(voxel.highest[axis], eighth)
        off = np.float32(end[axis]) - mean[axis]
        step = off / count
        mean[axis] += step
        squared += off * (off - step)
    voxel.spread += (squared - voxel.spread) / count


@kernel()
def record_ends(
    voxels: Doubles,
    start: int,
    seen: SeenVoxels,
    sighting: Sighting,
    observed: Observed,
    places: int,
    rows: int,
    found: Ints,
) -> tuple[int, int, int]:
    """Count rays that ended at ``voxels`` [N, 3]; returns (points done, places, rows in use).

    The row of each ray's voxel goes to ``found`` [N]; 0 outside the region.
    """
    for i in range(start, len(voxels)):
        end = (voxels[i, 0], voxels[i, 1], voxels[i, 2])
        x, y, z = int(np.floor(end[0])), int(np.floor(end[1])), int(np.floor(end[2]))
        block = find_block(seen.blocks, x, y, z, seen.side)
        found[i] = 0
        if block < 0:  # outside the region
            continue
        place = observed.places[block]
        if place == 0:
            if places == len(observed.seen_s):
                return i, places, rows
            place = places
            observed.places[block] = place
            places += 1
        voxel = byte_of(x, y) << SHIFT | (z & LOW)
        row = observed.rows[place, voxel]
        if row == 0:
            if rows == len(observed.voxels):
                return i, places, rows
            row = rows
            observed.rows[place, voxel] = row
            observed.voxels[row].owner = block << (3 * SHIFT) | voxel
            forget_ends(observed.voxels[row])
            rows += 1
        found[i] = row
        observed.seen_s[place] = max(observed.seen_s[place], sighting.stamp_s)
        known = observed.voxels[row]
        _add_ray(known, end, sighting)
        _begin_hit(known, sighting.scan)
        _add_end(known, (end[0] - x, end[1] - y, end[2] - z))
    return len(voxels), places, rows
