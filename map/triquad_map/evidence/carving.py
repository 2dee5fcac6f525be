"""Rays that carve: the voxels that they cross are free, surfaces that they pass contradicted.

A ray contradicts the surface in a voxel by the chance that it would have ended there: the ends in a
voxel lie about their mean as a Gaussian. Kernels stop where the index has no more room; the caller
makes room and goes on.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Ints

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
    PRIOR_ENDS,
    SAME_SURFACE,
    Observed,
    ObservedVoxel,
    Vector,
    Voxel,
    is_flat,
    voxel_of,
)
from triquad_map.evidence.seen_voxels import SeenVoxels

FREE_SHORT = 0.5  # voxels before its end up to which a ray shows free space

CLEAR_SHORT = 2.5
"""Voxels before its end up to which a ray shows that surface is not there: closer, it may belong to
what it ends on."""

_LEAST_SPREAD = 0.05
"""Standard deviation of the ends in a voxel in any direction, at least, in voxels."""

_PRIOR_SPREAD = 0.125
"""The same before any end, in all directions. With 0.1, 3.4 % of cars that were parked across are
left after ten scans, not 2.9; with 0.15, a crossing loses 0.13 % of what stands, not 0.05."""


class Passing(NamedTuple):
    """A ray, or the part of it in a region."""

    start: Vector  # voxels
    way: Vector  # unit vector
    first: Vector  # unit vectors across it
    second: Vector
    length: float  # voxels from the start to its end
    clear: float  # up to which it contradicts what it crosses
    scan: int  # number of its scan


@kernel(inline="always")
def _crosses(ray: Passing, corner: Voxel, voxel: ObservedVoxel) -> float:
    """Return the chance that a ray would have ended on the surface in a voxel, were it there.

    The ends in a voxel lie about their mean as a Gaussian: the chance is its density where the ray
    passes nearest, as a share of the greatest. Where they extend along the ray, it must also cross
    their plane, and not end on it.
    """
    way, mean, normal, spread = ray.way, voxel.mean, voxel.normal, voxel.spread
    to_x = corner[0] + mean[0] - ray.start[0]
    to_y = corner[1] + mean[1] - ray.start[1]
    to_z = corner[2] + mean[2] - ray.start[2]
    along = to_x * way[0] + to_y * way[1] + to_z * way[2]
    if not 0 <= along <= ray.clear:
        return 0.0
    first, second = ray.first, ray.second
    u = to_x * first[0] + to_y * first[1] + to_z * first[2]
    v = to_x * second[0] + to_y * second[1] + to_z * second[2]
    if u * u + v * v > 1:
        return 0.0
    share = float(voxel.ends) / (float(voxel.ends) + PRIOR_ENDS)
    prior = share * _LEAST_SPREAD**2 + (1 - share) * _PRIOR_SPREAD**2
    uu = share * _across(spread, first, first) + prior
    uv = share * _across(spread, first, second)
    vv = share * _across(spread, second, second) + prior
    square = (u * u * vv - 2 * u * v * uv + v * v * uu) / (uu * vv - uv * uv)
    chance = np.exp(-0.5 * square)
    if is_flat(voxel):
        facing = way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2]
        height = to_x * normal[0] + to_y * normal[1] + to_z * normal[2] - ray.length * facing
        ends_on_it = np.exp(-0.5 * (height / SAME_SURFACE) ** 2)
        crossing = _crosses_plane(ray, voxel, (to_x, to_y, to_z), facing, share, prior)
        # Only a surface that extends along the ray can be met farther on.
        extends = share * _across(spread, way, way) * 12 + (1 - share)
        chance *= 1 - min(extends, 1.0) * (1 - crossing * (1 - ends_on_it))
    return float(chance)


@kernel(inline="always")
def _crosses_plane(
    ray: Passing, voxel: ObservedVoxel, to: Vector, facing: float, share: float, prior: float
) -> float:
    """Return the density of the ends in a voxel where a ray crosses their plane."""
    way, normal = ray.way, voxel.normal
    if abs(facing) < 1e-3:
        return 0.0
    along = (to[0] * normal[0] + to[1] * normal[1] + to[2] * normal[2]) / facing
    off = (along * way[0] - to[0], along * way[1] - to[1], along * way[2] - to[2])
    square = off[0] * off[0] + off[1] * off[1] + off[2] * off[2]
    if square < 1e-6:
        return 1.0
    variance = share * _across(voxel.spread, off, off) / square + prior
    return float(np.exp(-0.5 * square / variance))


@kernel(inline="always")
def _across(spread: Floats, one: Vector, other: Vector) -> float:
    """Return the covariance of the ends of a voxel along two directions."""
    x = spread[0] * other[0] + spread[1] * other[1] + spread[2] * other[2]
    y = spread[1] * other[0] + spread[3] * other[1] + spread[4] * other[2]
    z = spread[2] * other[0] + spread[4] * other[1] + spread[5] * other[2]
    return float(one[0] * x + one[1] * y + one[2] * z)


@kernel(inline="always")
def _square_to(way: Vector) -> tuple[Vector, Vector]:
    """Return two unit vectors at right angles to a unit vector and to each other."""
    x, y, z = way
    if abs(z) < 0.9:
        size = np.sqrt(x * x + y * y)
        return (-y / size, x / size, 0.0), (-x * z / size, -y * z / size, size)
    size = np.sqrt(y * y + z * z)
    return (0.0, -z / size, y / size), (size, -x * y / size, -x * z / size)


_UNLIKELY = 0.05  # chance of a crossing below which a ray says nothing


@inner_kernel()
def note_passes(
    ray: Passing, crossed: Ints, seen: SeenVoxels, observed: Observed, passed: Ints
) -> None:
    """Count a ray that passes through the voxels of the rows ``crossed`` [N], in which rays ended.

    ``passed`` collects rows that rays of this scan passed, and in which none of them ended; its
    first number is how many follow.
    """
    for row in crossed:
        if row == 0:
            continue
        voxel = observed.voxels[row]
        chance = _crosses(ray, voxel_of(row, seen, observed), voxel)
        if chance < _UNLIKELY:
            continue
        if voxel.hit_scan == ray.scan:
            # The share of the scan's rays that ended there is the hit.
            before = voxel.crossed / (voxel.ended + voxel.crossed)
            voxel.crossed += chance
            more = voxel.crossed / (voxel.ended + voxel.crossed) - before
            voxel.hits -= more
            voxel.earlier_misses += more
            continue
        if voxel.passed_scan != ray.scan:
            voxel.passed_scan = ray.scan
            if voxel.misses == 0:
                voxel.missed_since = ray.scan
            voxel.crossed = 0
            passed[0] += 1
            passed[passed[0]] = row
        # Rays of one scan are no independent witnesses: together they count as one at most.
        voxel.misses += chance * (1 - voxel.crossed)
        voxel.crossed += chance * (1 - voxel.crossed)


_NO_ROOM = -2


class Reach(NamedTuple):
    """The distance before their ends at which rays stop to show what they cross, in voxels."""

    free: float  # that a voxel is free
    clear: float = np.inf  # that a surface is not there; infinite: never
    scan: int = 0  # number of the scan that the rays are of


@kernel(inline="always")
def _crossing(origin: float, direction: float) -> tuple[int, float, float]:
    """Return a ray's step on an axis, how far apart its crossings are, and how far the first."""
    if direction == 0:
        return 1, np.inf, np.inf
    fraction = origin - np.floor(origin)
    if direction > 0:
        return 1, 1 / direction, (1 - fraction) / direction
    return -1, -1 / direction, -fraction / direction


@kernel(inline="always")
def _inside(origin: float, direction: float, side: int) -> tuple[float, float]:
    """Return how far along a ray it enters and leaves the region on an axis."""
    if direction == 0:
        return (-np.inf, np.inf) if 0 <= origin <= side else (np.inf, -np.inf)
    a, b = -origin / direction, (side - origin) / direction
    return min(a, b), max(a, b)


@kernel(inline="always")
def part_inside(at: Vector, way: Vector, length: float, side: int) -> tuple[float, float]:
    """Return where the part of a ray begins and ends that lies in the region."""
    enters_x, leaves_x = _inside(at[0], way[0], side)
    enters_y, leaves_y = _inside(at[1], way[1], side)
    enters_z, leaves_z = _inside(at[2], way[2], side)
    first = max(0.0, enters_x, enters_y, enters_z)
    return first, min(length, leaves_x, leaves_y, leaves_z)


@inner_kernel()
def _walk(
    ray: Passing, reach: float, seen: SeenVoxels, count: int, observed: Observed, crossed: Ints
) -> tuple[int, int]:
    """Set the bits of the voxels on a way (Amanatides and Woo 1987); returns (blocks, rows) used.

    The rows of voxels in which rays ended go to ``crossed``: recorded here, they slow each step.
    """
    side, index, _, masks = seen
    at, way = ray.start, ray.way
    x, y, z = int(np.floor(at[0])), int(np.floor(at[1])), int(np.floor(at[2]))
    step_x, apart_x, next_x = _crossing(at[0], way[0])
    step_y, apart_y, next_y = _crossing(at[1], way[1])
    step_z, apart_z, next_z = _crossing(at[2], way[2])
    row, place, travelled, found, entered = -1, 0, 0.0, 0, True  # another block
    while travelled <= reach:
        if entered:
            row = -1
            if is_inside(x, y, z, side):
                row = make_row(index, count, block_key(x, y, z))
                if row < 0:
                    return _NO_ROOM, 0
                count = max(count, row + 1)
                place = observed.places[row] if travelled < ray.clear else 0
        if row >= 0:
            byte, bit = byte_of(x, y), bit_of(z)
            masks[row, byte] |= bit
            if place and observed.ended[place, byte] & bit and travelled < ray.clear:
                crossed[found] = observed.rows[place, byte << SHIFT | (z & LOW)]
                found += 1
        if next_x <= next_y and next_x <= next_z:
            travelled = next_x
            next_x += apart_x
            x += step_x
            entered = (x & LOW) == (0 if step_x > 0 else LOW)
        elif next_y <= next_z:
            travelled = next_y
            next_y += apart_y
            y += step_y
            entered = (y & LOW) == (0 if step_y > 0 else LOW)
        else:
            travelled = next_z
            next_z += apart_z
            z += step_z
            entered = (z & LOW) == (0 if step_z > 0 else LOW)
    return count, found


@kernel()
def mark_crossed(
    origin: Doubles,
    ends: Doubles,
    start: int,
    reach: Reach,
    seen: SeenVoxels,
    count: int,
    observed: Observed,
    passed: Ints,
) -> tuple[int, int]:
    """Set the bits of the voxels that rays cross; the rows that they pass go to ``passed``.

    Returns (rays done, blocks in use).
    """
    at = (origin[0], origin[1], origin[2])
    crossed = np.empty(3 * seen.side + 3, np.int32)  # no way has more voxels
    for i in range(start, len(ends)):
        dx, dy, dz = ends[i, 0] - at[0], ends[i, 1] - at[1], ends[i, 2] - at[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= reach.free:
            continue
        way = (dx / length, dy / length, dz / length)
        first, last = part_inside(at, way, length - reach.free, seen.side)
        if first > last:
            continue
        begin = (at[0] + first * way[0], at[1] + first * way[1], at[2] + first * way[2])
        across = _square_to(way)
        left = length - first
        ray = Passing(begin, way, across[0], across[1], left, left - reach.clear, reach.scan)
        used, found = _walk(ray, last - first, seen, count, observed, crossed)
        if used == _NO_ROOM:
            return i, count
        count = used
        if found:
            note_passes(ray, crossed[:found], seen, observed, passed)
    return len(ends), count
