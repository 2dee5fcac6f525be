"""The belief in the surface of a voxel: which appears once rays end there, and goes once they pass.

The logarithm of the odds that nothing is there is the sum of what the record of hits and misses
says, what rays that crossed since the last hit say, and what the voxels around say:

- Hits: ``vacant - stray * (hits + company)``. Nearly all space is vacant, and a return where
  nothing is may happen, but hardly again in the same voxel, nor with others of the scan that tell
  of a surface: these count as one hit more. How improbable the record of hits and misses would be
  of a surface is added: what rays meet now and then may be drops. However often a surface was seen,
  it may have left since: the sum is at least ``leaves``.
- Misses in a row since the last hit: how improbable they are while the surface is there. The chance
  that a ray ends in a voxel has a beta distribution, by Jeffreys' prior and the voxel's own record;
  probabilities are ratios of beta functions. So a fence, hit and missed by turns, is a fence.
- Around: a share of what two scans or more miss in the voxels around since this one was hit last,
  less as much for each that was hit since then. Things come and go as a whole.

The formulas, and where each number comes from: ``docs/design.md``, "Surface comes and goes".
"""

import math
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Ints, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, bit_of
from triquad_map.evidence.observed import (
    SAME_SURFACE,
    Observed,
    ObservedVoxel,
    Voxel,
    forget_ends,
    is_flat,
    rows_around,
    voxel_of,
)
from triquad_map.evidence.seen_voxels import SeenVoxels

_REACH = 2
"""How many voxels away others may belong together with one: far beams leave gaps of one."""

_PRIOR = 0.5  # hits and misses, scans: Jeffreys' prior of a chance

# The numbers of the model, logarithms of odds.
_VACANT = 5.0
"""That nothing is in a voxel of which nothing was seen: 1 in 150 has surface."""

_STRAY = 4.0
"""By how much that falls with each hit: 1 return in 50 comes from where nothing is."""

_LEAVES = -7.0
"""That a surface has left, however often it was seen: it does once in 1,100 times."""

_AROUND = 0.3
"""The share of what each voxel near by says that counts: it is no independent witness."""


class Changes(NamedTuple):
    """The voxels whose surface came or went."""

    new: Longs  # [M, 3]
    removed: Longs  # [K, 3]


@inner_kernel()
def _bit(row: int, observed: Observed) -> tuple[int, int, int]:
    """Return where the surface bit of a row is: block, byte and mask."""
    owner = observed.voxels[row].owner
    return owner >> (3 * SHIFT), owner >> SHIFT & (1 << (2 * SHIFT)) - 1, bit_of(owner & LOW)


@inner_kernel()
def _has_surface(row: int, seen: SeenVoxels, observed: Observed) -> bool:
    """Return whether the surface of a row is still believed."""
    block, byte, bit = _bit(row, observed)
    return bool(seen.surface[block, byte] & bit)


@kernel()
def have_surface(rows: Ints, seen: SeenVoxels, observed: Observed) -> Bools:
    """Return whether the surface of each row [N] is believed; not outside the region."""
    found = np.zeros(len(rows), np.bool_)
    for i, row in enumerate(rows):
        found[i] = row != 0 and _has_surface(row, seen, observed)
    return found


@inner_kernel()
def _log_beta(hits: float, misses: float) -> float:
    """Return the logarithm of the beta function at what was seen, with the prior."""
    a, b = hits + _PRIOR, misses + _PRIOR
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@inner_kernel()
def _recorded(voxel: ObservedVoxel) -> float:
    """Return how improbable a record of hits and misses is: minus the logarithm."""
    return _log_beta(0.0, 0.0) - _log_beta(voxel.hits, voxel.earlier_misses)


@inner_kernel()
def _missed(voxel: ObservedVoxel) -> float:
    """Return how improbable the misses since the last hit are, after the record."""
    all_misses = voxel.earlier_misses + voxel.misses
    return _log_beta(voxel.hits, voxel.earlier_misses) - _log_beta(voxel.hits, all_misses)


@inner_kernel()
def _coupling(row: int, other: int, seen: SeenVoxels, observed: Observed) -> float:
    """Return how likely the surfaces in two voxels belong together, by the planes of their ends."""
    one, two = observed.voxels[row], observed.voxels[other]
    x, y, z = voxel_of(row, seen, observed)
    i, j, k = voxel_of(other, seen, observed)
    dx = x - i + float(one.mean[0]) - float(two.mean[0])
    dy = y - j + float(one.mean[1]) - float(two.mean[1])
    dz = z - k + float(one.mean[2]) - float(two.mean[2])
    if is_flat(two):
        height = dx * two.normal[0] + dy * two.normal[1] + dz * two.normal[2]
    elif is_flat(one):
        height = dx * one.normal[0] + dy * one.normal[1] + dz * one.normal[2]
    else:
        height = 0.5 * np.sqrt(dx * dx + dy * dy + dz * dz)
    return float(np.exp(-0.5 * (height / SAME_SURFACE) ** 2))


@inner_kernel()
def _own_odds(voxel: ObservedVoxel) -> float:
    """Return the logarithm of the odds that a voxel has no surface, by its own record."""
    hits = float(voxel.hits)
    if voxel.company:
        hits = max(hits, 1.0) + 1.0  # a whole one, even if other rays of its scan passed
    recorded = _VACANT - _STRAY * hits + _recorded(voxel)
    return float(max(recorded, _LEAVES) + _missed(voxel))


@inner_kernel()
def _odds(row: int, near: Ints, seen: SeenVoxels, observed: Observed) -> float:
    """Return the same by what rays have shown around it, too, in the rows ``near``."""
    voxel = observed.voxels[row]
    around = 0.0
    since = voxel.missed_since if voxel.misses > 0 else np.int32(1 << 30)
    for other in near:
        one = observed.voxels[other]
        if one.misses > 0 and one.missed_since > voxel.hit_scan:
            since = min(since, one.missed_since)
    for other in near:
        one = observed.voxels[other]
        if other == row:
            continue
        if one.misses > 0 and one.missed_since > voxel.hit_scan:
            if one.missed_since == one.passed_scan:
                continue  # a single scan may have a wrong pose: it is one witness for all it misses
            is_gone = not _has_surface(np.int64(other), seen, observed)
            says = _VACANT if is_gone else min(_missed(one), _VACANT)
        elif one.misses == 0 and one.ends > 0 and one.hit_scan >= since:
            says = -_VACANT
        else:
            continue
        around += _AROUND * _coupling(row, np.int64(other), seen, observed) * says
    return float(_own_odds(voxel) + max(around, -_VACANT))


@inner_kernel()
def _appear(hit: Ints, seen: SeenVoxels, observed: Observed, come: list[Voxel]) -> None:
    """Let surface come in the rows ``hit`` where it has become probable.

    Where it has not, nothing is known: the rays that ended there have not shown that it is free.
    """
    for row in hit:
        if row == 0 or _has_surface(row, seen, observed):
            continue
        block, byte, bit = _bit(row, observed)
        if _own_odds(observed.voxels[row]) > 0:
            seen.free[block, byte] &= ~bit
            continue
        seen.surface[block, byte] |= bit
        come.append(voxel_of(row, seen, observed))


@inner_kernel()
def _go(waiting: list[int], seen: SeenVoxels, observed: Observed, gone: list[Voxel]) -> None:
    """Let surface go in the rows ``waiting``, and in those near by that were not hit since."""
    while len(waiting):
        row = waiting.pop()
        voxel = observed.voxels[row]
        if not _has_surface(row, seen, observed):
            # Nothing is left of what hits said: the next begins anew.
            if voxel.ends > 0 and _own_odds(voxel) >= _VACANT:
                forget_ends(voxel)
            continue
        near = rows_around(row, _REACH, seen, observed)
        if _odds(row, near, seen, observed) <= 0:
            continue
        block, byte, bit = _bit(row, observed)
        seen.surface[block, byte] &= ~bit
        gone.append(voxel_of(row, seen, observed))
        since = max(voxel.passed_scan, voxel.hit_scan + 1)
        for other in near:
            if observed.voxels[other].hit_scan < since and other != row:
                waiting.append(np.int64(other))
        forget_ends(voxel)


@kernel()
def believe(hit: Ints, passed: Ints, seen: SeenVoxels, observed: Observed) -> tuple[Longs, Longs]:
    """Let surface come in the rows ``hit`` by the newest scan, and go in those it ``passed``.

    Returns the voxels [M, 3] that have surface now, and those [K, 3] that have none any more.
    """
    come = [voxel_of(0, seen, observed) for _ in range(0)]
    gone = [voxel_of(0, seen, observed) for _ in range(0)]
    waiting = [np.int64(0) for _ in range(0)]
    for row in passed:
        # Those that are hardly missed go only after one near by.
        if _own_odds(observed.voxels[row]) > -_VACANT:
            waiting.append(np.int64(row))
    _go(waiting, seen, observed, gone)
    _appear(hit, seen, observed, come)
    return _array(come), _array(gone)


@inner_kernel()
def _array(voxels: list[Voxel]) -> Longs:
    found = np.empty((len(voxels), 3), np.int64)
    for number, (x, y, z) in enumerate(voxels):
        found[number, 0], found[number, 1], found[number, 2] = x, y, z
    return found
