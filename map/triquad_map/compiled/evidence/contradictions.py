"""When a surface that was seen is no longer there: rays pass where rays ended.

No other ray of such a scan may end in the voxel. Thin things, edges and far ground are hit and
passed alternately; so rays in a row count for what they are worth by a voxel's own record: how
improbable are they, given how often rays passed between the hits before (the predictive
distribution of a beta prior)?
"""

import math
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Ints, Longs

from triquad_map.compiled.evidence.observed import (
    EARLIER_MISSES,
    EARLIER_PASSES,
    ENDS,
    HIT_SCAN,
    HITS,
    MEAN,
    MISSES,
    PASS_SCANS,
    PASSED_SCAN,
    PASSES,
    SECTORS,
    WEIGHT,
    Observed,
    row_of,
)
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, bit_of, byte_of, unpack

_PRIOR_HITS, _PRIOR_PASSES = 0.3, 0.7
"""What is taken to have been seen of a voxel before anything was: one ray in all."""

_MOST_COUNTED = 200
_OWN_RECORD_HITS = 3
"""A voxel with fewer hits has no record of its own that could speak against its neighbours."""

_LEAST_GONE = 3
"""So many voxels around must be gone to take one along that rays need not have passed."""

_SOLID_HITS = 20
"""A surface that was hit so many times for each time it was crossed has no gaps: crossings of all
its voxels count together."""

_SCANS_AROUND = 2  # times those that a voxel's own record asks for, where rays need not cross it


class Disbelief(NamedTuple):
    """When a surface counts as gone."""

    scans: int  # at least so many in a row, of which rays passed and none ended there
    own: float  # and so improbable are their crossings: logarithm of the probability
    around: float  # or so improbable what passed a voxel and all those around it
    shared: float  # or so improbable its passes alone, where half of those around it are gone
    witnessed: float  # or so improbable its crossings, where the field shows no surface either

    @classmethod
    def of(cls, scans: int, doubt: float) -> "Disbelief":
        """The rule by which own crossings in ``scans`` that are less probable than ``doubt`` count.

        The other signs are weighed by how many wrong ones each gives in a world that stands still.
        """
        own = math.log(doubt)
        return cls(scans, own, around=3 * own, shared=own + math.log(2), witnessed=own / 2)


Voxel = tuple[int, int, int]


@kernel()
def _improbability(passes: int, earlier: int, hits: int) -> float:
    """Logarithm of how probable so many passes in a row are, by what was seen earlier."""
    a, b = hits + _PRIOR_HITS, earlier + _PRIOR_PASSES
    total = 0.0
    for i in range(min(passes, _MOST_COUNTED)):
        total += np.log((b + i) / (a + b + i))
    return total


@kernel()
def _voxel_of(row: int, seen: SeenVoxels, observed: Observed) -> Voxel:
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


class Around(NamedTuple):
    """A voxel and those around it in which rays ended, together."""

    known: int  # of those around it
    gone: int  # of these, whose surface is not believed any more
    doubted: int  # of these, that are believed, and that rays passed since
    scans: int  # most in a row of which rays passed one of them
    misses: int
    earlier_misses: int
    passes: int
    earlier_passes: int
    hits: int


@kernel()
def _around(row: int, seen: SeenVoxels, observed: Observed) -> Around:
    """What is known of a voxel and those around it."""
    x, y, z = _voxel_of(row, seen, observed)
    known = gone = doubted = scans = misses = earlier_misses = passes = earlier = hits = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                near = row_of(seen, observed, x + i, y + j, z + k)
                if near == 0:
                    continue
                other = observed.counts[near]
                scans = max(scans, other[PASS_SCANS])
                misses += other[MISSES]
                earlier_misses += other[EARLIER_MISSES]
                passes += other[PASSES]
                earlier += other[EARLIER_PASSES]
                hits += other[HITS]
                if near == row:
                    continue
                known += 1
                if not _has_surface(near, seen, observed):
                    gone += 1
                elif other[PASS_SCANS] > 0:
                    doubted += 1
    return Around(known, gone, doubted, scans, misses, earlier_misses, passes, earlier, hits)


@kernel()
def _goes_along(counts: Ints, around: Around, rule: Disbelief) -> bool:
    """Whether a surface goes since those around it are gone.

    A thing goes as a whole: no ray need pass each of its voxels. What has a record of its own goes
    only if that speaks for it, or if no ray passed and two thirds are gone.
    """
    if around.gone == 0 or 2 * around.gone < around.known:
        return False
    all_gone = around.gone == around.known and counts[PASS_SCANS] >= rule.scans
    if around.gone < _LEAST_GONE and not all_gone:
        return False
    if counts[HITS] < _OWN_RECORD_HITS:
        return True
    if counts[PASSES] == 0:  # which says nothing either way
        return bool(3 * around.gone >= 2 * around.known)
    share = (counts[EARLIER_PASSES] + 0.5) / (counts[HITS] + counts[EARLIER_PASSES] + 1.0)
    return bool(counts[PASSES] * np.log(share) <= rule.shared)


@kernel()
def _is_doubted_around(counts: Ints, around: Around, rule: Disbelief) -> bool:
    """Whether no surface around a voxel is believed, and what passed all of it is improbable."""
    if around.gone + around.doubted < around.known:
        return False
    solid = around.hits >= _SOLID_HITS * around.earlier_misses
    if solid and counts[MISSES] and around.scans >= rule.scans:
        if _improbability(around.misses, around.earlier_misses, around.hits) < rule.around:
            return True
    if counts[PASS_SCANS] < _SCANS_AROUND * rule.scans:
        return False
    return _improbability(around.passes, around.earlier_passes, around.hits) < rule.around


@kernel()
def _is_gone(row: int, seen: SeenVoxels, observed: Observed, rule: Disbelief) -> bool:
    """Whether the surface of a voxel is gone, by its own record or with those around it."""
    counts = observed.counts[row]
    if counts[PASS_SCANS] >= rule.scans and counts[MISSES] >= rule.scans:
        own = _improbability(counts[MISSES], counts[EARLIER_MISSES], counts[HITS])
        if own < rule.own:
            return True
    around = _around(row, seen, observed)
    return _goes_along(counts, around, rule) or _is_doubted_around(counts, around, rule)


@kernel()
def _take_back(
    row: int, seen: SeenVoxels, observed: Observed, taken: list[Voxel], waiting: list[int]
) -> None:
    """Clear the surface bit of a row, whose support begins anew, and add its voxel to ``taken``.

    Those around it that were not hit since it was passed are added to ``waiting``.
    """
    x, y, z = _voxel_of(row, seen, observed)
    taken.append((x, y, z))
    seen.surface[observed.owners[row] >> (3 * SHIFT), byte_of(x, y)] &= ~bit_of(z)
    observed.shapes[row, WEIGHT] = observed.shapes[row, ENDS] = 0
    observed.counts[row, SECTORS] = 0
    passed_scan = observed.counts[row, PASSED_SCAN]
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                near = row_of(seen, observed, x + i, y + j, z + k)
                if near != 0 and observed.counts[near, HIT_SCAN] < passed_scan:
                    waiting.append(near)


@kernel()
def take_back(
    gone: Longs, passed: Ints, seen: SeenVoxels, observed: Observed, rule: Disbelief
) -> Longs:
    """Take back the surface of voxels that are contradicted; returns them [M, 3].

    That of the rows ``gone`` is; that of ``passed``, by rays of the newest scan, may be. With what
    goes, those around it are asked once more.
    """
    taken = [_voxel_of(0, seen, observed) for _ in range(0)]
    waiting = [np.int64(row) for row in passed if observed.counts[row, PASS_SCANS] >= rule.scans]
    for row in gone:
        _take_back(row, seen, observed, taken, waiting)
    while len(waiting):
        row = waiting.pop()
        if _has_surface(row, seen, observed) and _is_gone(row, seen, observed, rule):
            _take_back(row, seen, observed, taken, waiting)
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
