"""The decision that a surface that was seen is no longer there: rays pass where rays ended.

No other ray of such a scan may end in the voxel. Thin things, edges and far ground are hit and
passed alternately; so rays in a row count for what they are worth by a voxel's own record: how
improbable are they, given how often rays passed between the hits before (the predictive
distribution of a beta prior)?
"""

import math
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Ints, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import SHIFT, bit_of, byte_of
from triquad_map.evidence.observed import (
    Observed,
    ObservedVoxel,
    Voxel,
    forget_ends,
    has_surface,
    rows_around,
    voxel_of,
)
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.evidence.surroundings import Around, depth_around, seen_around

_PRIOR_HITS, _PRIOR_PASSES = 0.3, 0.7
"""The prior of a voxel before anything was seen of it: one ray in all."""

_MOST_COUNTED = 200
_OWN_RECORD_HITS = 3
"""A voxel with fewer hits has no record of its own that could speak against its neighbours."""

_LEAST_GONE = 3
"""The least removed voxels around one to remove it where rays need not have passed it."""

_SOLID_HITS = 20
"""A surface that was hit this often for each time it was crossed has no gaps: crossings of all
its voxels count together."""

_SCANS_AROUND = 2  # times those that a voxel's own record asks for, where rays need not cross it

_GROUP_REACH = 2
"""Voxels around one without a record of its own, that are checked with it: few rays reach a far
thing, and leave voxels between them out."""

_GROUP_GONE = 0.25
"""The share of such a group whose removal removes the rest of it."""

_GROUP_FLAT = 0.7
"""A group that is deeper than this along the rays, voxels, rays may pass without crossing it."""

_GROUP_SPAN = 2
"""A group that was hit over more scans than this may be leaves, between which rays pass."""


class Disbelief(NamedTuple):
    """The rule for when a surface counts as removed."""

    scans: int  # at least this number in a row, of which rays passed and none ended there
    own: float  # and so improbable are their crossings: logarithm of the probability
    around: float  # or so improbable what passed a voxel and those around it
    shared: float  # or so improbable its passes alone, where half of those around it are removed
    witnessed: float  # or so improbable its crossings, where the field shows no surface either

    @classmethod
    def of(cls, scans: int, doubt: float) -> "Disbelief":
        """Return the rule that counts own crossings in ``scans`` less probable than ``doubt``.

        The other signs are weighed by how many wrong ones each gives in a world that stands still.
        """
        own = math.log(doubt)
        return cls(scans, own, around=3 * own, shared=own + math.log(2), witnessed=own / 2)


@inner_kernel()
def _improbability(passes: int, earlier: int, hits: int) -> float:
    """Return the logarithm of how probable the passes in a row are, by what was seen earlier."""
    a, b = hits + _PRIOR_HITS, earlier + _PRIOR_PASSES
    total = 0.0
    for i in range(min(passes, _MOST_COUNTED)):
        total += np.log((b + i) / (a + b + i))
    return total


@inner_kernel()
def _own_improbability(voxel: ObservedVoxel) -> float:
    """Return the logarithm of how probable the crossings of a voxel are by its own record.

    As many in a row, at any time so far: each hit gave chance another try (Bonferroni).
    """
    tries = max(1, voxel.hits)
    own = _improbability(voxel.misses, voxel.earlier_misses, voxel.hits)
    return float(own + np.log(tries))


@inner_kernel()
def _goes_along(voxel: ObservedVoxel, around: Around, rule: Disbelief) -> bool:
    """Return whether a surface is removed since those around it are.

    A thing is removed as a whole: no ray need pass each of its voxels. One with its own record is
    only if that speaks for it, or if no ray passed and two thirds are removed.
    """
    if around.gone == 0 or 2 * around.gone < around.known:
        return False
    all_gone = around.gone == around.known and voxel.pass_scans >= rule.scans
    if around.gone < _LEAST_GONE and not all_gone:
        return False
    if voxel.hits < _OWN_RECORD_HITS:
        return True
    if voxel.passes == 0:  # which says nothing either way
        return bool(3 * around.gone >= 2 * around.known)
    share = (voxel.earlier_passes + 0.5) / (voxel.hits + voxel.earlier_passes + 1.0)
    return bool(voxel.passes * np.log(share) + np.log(voxel.hits) <= rule.shared)


@inner_kernel()
def _is_doubted_around(voxel: ObservedVoxel, around: Around, rule: Disbelief) -> bool:
    """Return whether no surface around a voxel is believed, and all passes are improbable."""
    if around.gone + around.doubted < around.known:
        return False
    is_solid = around.hits >= _SOLID_HITS * around.earlier_misses
    if is_solid and voxel.misses and around.scans >= rule.scans:
        crossed = _improbability(around.misses, around.earlier_misses, around.hits)
        if crossed < rule.around:
            return True
    if voxel.pass_scans < _SCANS_AROUND * rule.scans:
        return False
    return _improbability(around.passes, around.earlier_passes, around.hits) < rule.around


@inner_kernel()
def _goes_with_group(row: int, seen: SeenVoxels, observed: Observed, rule: Disbelief) -> bool:
    """Return whether a surface without a record is removed with those two voxels around.

    A hit there that came later, and that no ray passed since, speaks for all of it.
    """
    voxel, group = observed.voxels[row], seen_around(row, _GROUP_REACH, seen, observed)
    if group.later > 0:
        return False
    if group.gone >= _LEAST_GONE and group.gone >= _GROUP_GONE * group.known:
        return True
    if voxel.pass_scans < rule.scans or group.hit_span > _GROUP_SPAN:
        return False
    if _improbability(group.passes, group.earlier_passes, group.hits) >= rule.around:
        return False
    return depth_around(row, _GROUP_REACH, seen, observed) < _GROUP_FLAT


@inner_kernel()
def _is_gone(row: int, seen: SeenVoxels, observed: Observed, rule: Disbelief) -> bool:
    """Return whether a voxel's surface is removed, by its own record or with those around it."""
    voxel = observed.voxels[row]
    scans = min(voxel.pass_scans, voxel.misses)
    if scans >= rule.scans and _own_improbability(voxel) < rule.own:
        return True
    around = seen_around(row, 1, seen, observed)
    if _goes_along(voxel, around, rule) or _is_doubted_around(voxel, around, rule):
        return True
    if voxel.hits >= _OWN_RECORD_HITS or around.later > 0:  # which spares a further search
        return False
    return _goes_with_group(row, seen, observed, rule)


@inner_kernel()
def _take_back(
    row: int, seen: SeenVoxels, observed: Observed, taken: list[Voxel], waiting: list[int]
) -> None:
    """Clear the surface bit of a row, whose support begins again, and add its voxel to ``taken``.

    Those near it that were not hit since are added to ``waiting``.
    """
    voxel = observed.voxels[row]
    x, y, z = voxel_of(row, seen, observed)
    taken.append((x, y, z))
    seen.surface[voxel.owner >> (3 * SHIFT), byte_of(x, y)] &= ~bit_of(z)
    forget_ends(voxel)
    since = max(voxel.passed_scan, voxel.hit_scan + 1)
    for near in rows_around(row, _GROUP_REACH, seen, observed):
        if observed.voxels[near].hit_scan < since:
            waiting.append(near)


@kernel()
def take_back(
    gone: Longs, passed: Ints, seen: SeenVoxels, observed: Observed, rule: Disbelief
) -> Longs:
    """Remove the surface of voxels that are contradicted; returns them [M, 3].

    That of the rows ``gone`` is; that of ``passed``, by rays of the newest scan, may be. After each
    removal, those near it are checked once more.
    """
    taken = [voxel_of(0, seen, observed) for _ in range(0)]
    waiting = [np.int64(row) for row in passed if observed.voxels[row].pass_scans >= rule.scans]
    for row in gone:
        _take_back(row, seen, observed, taken, waiting)
    while len(waiting):
        row = waiting.pop()
        if has_surface(row, seen, observed) and _is_gone(row, seen, observed, rule):
            _take_back(row, seen, observed, taken, waiting)
    voxels = np.empty((len(taken), 3), np.int64)
    for number, (x, y, z) in enumerate(taken):
        voxels[number, 0], voxels[number, 1], voxels[number, 2] = x, y, z
    return voxels


@kernel()
def doubted(passed: Ints, seen: SeenVoxels, observed: Observed, rule: Disbelief) -> Longs:
    """Return the rows of ``passed`` whose surface is removed if the field shows none either."""
    chosen = np.empty(len(passed), np.int64)
    count = 0
    for row in passed:
        voxel = observed.voxels[row]
        if voxel.misses == 0 or not has_surface(row, seen, observed):
            continue
        if _own_improbability(voxel) < rule.witnessed:
            chosen[count] = row
            count += 1
    return chosen[:count]


@kernel()
def middles(rows: Longs, seen: SeenVoxels, observed: Observed) -> Doubles:
    """Return where the surface of ``rows`` [N] was seen [N, 3], voxels."""
    places = np.empty((len(rows), 3))
    for i, row in enumerate(rows):
        voxel, mean = voxel_of(row, seen, observed), observed.voxels[row].mean
        for axis in range(3):
            places[i, axis] = voxel[axis] + mean[axis]
    return places
