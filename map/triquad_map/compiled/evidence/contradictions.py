"""When a surface that was seen is no longer there: rays that pass where rays ended.

A ray contradicts a surface only where it crosses it: a disc around the middle of the ends in a
voxel, as wide as they spread, far enough from where the ray ends itself, and no other ray of its
scan may end in the voxel. Where too little is known for a disc, a ray that passes the voxel counts
as a weaker sign. Thin things, edges and far ground are hit and passed by turns; so rays in a row
count for what they are worth by a voxel's own record: how improbable are they, given how often
rays passed between the hits before (the predictive distribution of a beta prior)?
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Ints, Longs

from triquad_map.compiled.evidence.observed import (
    EARLIER_MISSES,
    EARLIER_PASSES,
    ENDS,
    HIT_SCAN,
    HITS,
    MEAN,
    MISSES,
    NORMAL,
    PASS_SCANS,
    PASSED_SCAN,
    PASSES,
    SECTORS,
    SPREAD,
    WEIGHT,
    Observed,
    Vector,
    row_of,
)
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, bit_of, byte_of, unpack

_SPREAD_SHARE = 0.8
_LEAST_RADIUS, _GREATEST_RADIUS = 0.15, 0.5
"""The disc's radius: a share of the ends' spread, between these, in voxels."""

_GRAZING = 0.05
"""Cosine between ray and normal below which a ray must end deeper behind the surface."""

_LEAST_COSINE = 0.01
_DEPTH, _GRAZING_DEPTH = 0.2, 0.5  # voxels behind the surface

_KNOWN_ENDS = 8
"""Where so many rays ended on a plane, only rays that cross it count."""

_PRIOR_HITS, _PRIOR_PASSES = 0.3, 0.7
_MOST_COUNTED = 200
_OWN_RECORD_HITS = 3
"""A voxel with fewer hits has no record of its own that could speak against its neighbours."""

_LEAST_GONE = 3
_SCANS_AROUND = 2  # times those that a voxel's own record asks for


class Disbelief(NamedTuple):
    """When a surface counts as gone."""

    scans: int  # at least so many in a row, of which rays passed and none ended there
    own: float  # and so improbable are their crossings: logarithm of the probability
    around: float  # or so improbable the passes of a voxel and all those around it
    shared: float  # or so improbable its passes alone, where half of those around it are gone
    witnessed: float  # or so improbable its crossings, where the field shows no surface either


class Passing(NamedTuple):
    """A ray, or the part of it in a region."""

    start: Vector  # voxels
    way: Vector  # unit vector
    clear: float  # voxels from the start, up to which it contradicts what it crosses
    scan: int  # number of its scan


@kernel()
def _crosses(ray: Passing, corner: Vector, shape: Floats, flat: bool) -> bool:
    """Whether a ray crosses the disc of the surface in a voxel at its least ``corner``."""
    facing, reached, along = 0.0, 0.0, 0.0
    for axis in range(3):
        to_middle = corner[axis] + shape[MEAN + axis] - ray.start[axis]
        facing += ray.way[axis] * shape[NORMAL + axis]
        reached += to_middle * shape[NORMAL + axis]
        along += to_middle * ray.way[axis]
    if flat:
        if abs(facing) < _LEAST_COSINE:
            return False
        along = reached / facing
        depth = _DEPTH if abs(facing) >= _GRAZING else _GRAZING_DEPTH
        if (ray.clear - along) * abs(facing) < depth:
            return False
    if not 0 <= along <= ray.clear:
        return False
    squared = 0.0
    for axis in range(3):
        middle = corner[axis] + shape[MEAN + axis]
        squared += (ray.start[axis] + along * ray.way[axis] - middle) ** 2
    radius = _SPREAD_SHARE * np.sqrt(shape[SPREAD]) if flat else 0.0
    return bool(squared <= min(max(radius, _LEAST_RADIUS), _GREATEST_RADIUS) ** 2)


@kernel()
def note_pass(
    ray: Passing, corner: Vector, row: int, shapes: Floats, counts: Ints, passed: Ints
) -> None:
    """Count a ray that passes through the voxel of a row, in which rays ended.

    ``passed`` collects rows that rays of this scan passed, and in which none of them ended; its
    first number is how many follow.
    """
    if row == 0:
        return
    shape, count = shapes[row], counts[row]
    flat = shape[NORMAL] != 0 or shape[NORMAL + 1] != 0 or shape[NORMAL + 2] != 0
    crossing = _crosses(ray, corner, shape, flat)
    if not crossing and flat and shape[ENDS] >= _KNOWN_ENDS:
        return
    if count[HIT_SCAN] == ray.scan:
        count[EARLIER_PASSES] += 1
        count[EARLIER_MISSES] += crossing
        return
    count[PASSES] += 1
    count[MISSES] += crossing
    if count[PASSED_SCAN] != ray.scan:
        count[PASSED_SCAN] = ray.scan
        count[PASS_SCANS] += 1
        passed[0] += 1
        passed[passed[0]] = row


@kernel()
def _improbability(passes: int, earlier: int, hits: int) -> float:
    """Logarithm of how probable so many passes in a row are, by what was seen earlier."""
    a, b = hits + _PRIOR_HITS, earlier + _PRIOR_PASSES
    total = 0.0
    for i in range(min(passes, _MOST_COUNTED)):
        total += np.log((b + i) / (a + b + i))
    return total


@kernel()
def _voxel_of(row: int, seen: SeenVoxels, observed: Observed) -> tuple[int, int, int]:
    """The voxel of a row."""
    owner = observed.owners[row]
    x, y, z = unpack(seen.blocks.row_keys[owner >> (3 * SHIFT)])
    return (
        (x << SHIFT) + (owner >> (2 * SHIFT) & LOW),
        (y << SHIFT) + (owner >> SHIFT & LOW),
        (z << SHIFT) + (owner & LOW),
    )


@kernel()
def _has_surface(row: int, seen: SeenVoxels, observed: Observed) -> bool:
    """Whether the surface of a row is still believed."""
    owner = observed.owners[row]
    block = owner >> (3 * SHIFT)
    return bool(seen.surface[block, owner >> SHIFT & (1 << (2 * SHIFT)) - 1] & bit_of(owner & LOW))


@kernel()
def _is_gone(row: int, seen: SeenVoxels, observed: Observed, rule: Disbelief) -> bool:
    """Whether the surface of a voxel is gone, by its own record or with those around it."""
    counts = observed.counts[row]
    if counts[PASS_SCANS] >= rule.scans and counts[MISSES] >= rule.scans:
        own = _improbability(counts[MISSES], counts[EARLIER_MISSES], counts[HITS])
        if own < rule.own:
            return True
    passes, earlier, hits = counts[PASSES], counts[EARLIER_PASSES], counts[HITS]
    if hits >= _OWN_RECORD_HITS:
        share = (earlier + 0.5) / (hits + earlier + 1.0)
        if passes * np.log(share) > rule.shared:
            return False
    x, y, z = _voxel_of(row, seen, observed)
    known = gone = doubted = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                near = row_of(seen, observed, x + i, y + j, z + k)
                if near == 0 or near == row:
                    continue
                other = observed.counts[near]
                known += 1
                passes += other[PASSES]
                earlier += other[EARLIER_PASSES]
                hits += other[HITS]
                if not _has_surface(near, seen, observed):
                    gone += 1
                elif other[PASS_SCANS] > 0:
                    doubted += 1
    if gone >= _LEAST_GONE and 2 * gone >= known:
        return True
    if counts[PASS_SCANS] < _SCANS_AROUND * rule.scans or gone + doubted < known:
        return False
    return _improbability(passes, earlier, hits) < rule.around


@kernel()
def _take_back(row: int, seen: SeenVoxels, observed: Observed) -> tuple[int, int, int]:
    """Clear the surface bit of a row; what supports it begins anew. Returns its voxel."""
    x, y, z = _voxel_of(row, seen, observed)
    seen.surface[observed.owners[row] >> (3 * SHIFT), byte_of(x, y)] &= ~bit_of(z)
    observed.shapes[row, WEIGHT] = observed.shapes[row, ENDS] = 0
    observed.counts[row, SECTORS] = 0
    return x, y, z


@kernel()
def take_back(passed: Ints, seen: SeenVoxels, observed: Observed, rule: Disbelief) -> Longs:
    """Take back the surface of voxels that are contradicted; returns them [M, 3].

    ``passed`` are the rows that rays of the newest scan passed. What goes takes with it those
    around it whose surface hung on it.
    """
    taken = [_voxel_of(0, seen, observed) for _ in range(0)]
    waiting = [row for row in passed if observed.counts[row, PASS_SCANS] >= rule.scans]
    while len(waiting):
        row = waiting.pop()
        if not (_has_surface(row, seen, observed) and _is_gone(row, seen, observed, rule)):
            continue
        x, y, z = _take_back(row, seen, observed)
        taken.append((x, y, z))
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    near = row_of(seen, observed, x + i, y + j, z + k)
                    if near != 0 and observed.counts[near, PASS_SCANS] > 0:
                        waiting.append(near)
    voxels = np.empty((len(taken), 3), np.int64)
    for number, (x, y, z) in enumerate(taken):
        voxels[number, 0], voxels[number, 1], voxels[number, 2] = x, y, z
    return voxels


@kernel()
def doubted(passed: Ints, seen: SeenVoxels, observed: Observed, rule: Disbelief) -> Longs:
    """Those of the rows ``passed`` whose surface is gone if the field shows none there either."""
    chosen = np.empty(len(passed), np.int64)
    count = 0
    for row in passed:
        counts = observed.counts[row]
        if counts[MISSES] == 0 or not _has_surface(row, seen, observed):
            continue
        own = _improbability(counts[MISSES], counts[EARLIER_MISSES], counts[HITS])
        if own < rule.witnessed:
            chosen[count] = row
            count += 1
    return chosen[:count]


@kernel()
def middles(rows: Longs, seen: SeenVoxels, observed: Observed) -> Doubles:
    """Where the surface of ``rows`` [N] was seen [N, 3], voxels."""
    places = np.empty((len(rows), 3))
    for i, row in enumerate(rows):
        x, y, z = _voxel_of(row, seen, observed)
        places[i, 0] = x + observed.shapes[row, MEAN]
        places[i, 1] = y + observed.shapes[row, MEAN + 1]
        places[i, 2] = z + observed.shapes[row, MEAN + 2]
    return places


@kernel()
def take_back_rows(rows: Longs, seen: SeenVoxels, observed: Observed) -> Longs:
    """Take back the surface of ``rows`` [N]; returns their voxels [N, 3]."""
    voxels = np.empty((len(rows), 3), np.int64)
    for i, row in enumerate(rows):
        voxels[i, 0], voxels[i, 1], voxels[i, 2] = _take_back(row, seen, observed)
    return voxels
