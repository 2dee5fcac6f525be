"""The belief in the surface of a voxel: which is removed once rays contradict it.

The logarithm of the odds that nothing is there is the sum of what hits say, what rays that crossed
without ending say, and what the voxels around say:

- Hits: ``max(vacant - stray * hits, leaves)``. Nearly all space is vacant, and a return where
  nothing is may happen, but hardly again in the same voxel. However often a surface was seen, it
  may have left since.
- Misses in a row since the last hit: how improbable they are while the surface is there. A voxel's
  own record of hits and misses gives a beta distribution of the chance that a ray ends in it
  (Jeffreys' prior); its prediction of as many misses is a ratio of gamma functions. So a fence,
  hit and missed by turns, is a fence.
- Around: a share of what is missed in the voxels around since this one was hit last, less as much
  for each that was hit since then, but together no more than one can. Things come and go as a
  whole.
"""

import math
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Ints, Longs

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

_JEFFREYS = 0.5


class Belief(NamedTuple):
    """The numbers of the model, logarithms of odds."""

    vacant: float = 2.0  # that nothing is in a voxel of which nothing was seen
    stray: float = 3.0  # how much less for each hit: one return in 20 is where nothing is
    leaves: float = -7.0  # that a surface has left, however often it was seen
    around: float = 0.5  # share of what each voxel around says
    most: float = 5.0  # that a voxel around says, and that all together say for the surface


@inner_kernel()
def _missed(voxel: ObservedVoxel) -> float:
    """Return how improbable the misses since the last hit are: minus the logarithm."""
    a, b = voxel.hits + _JEFFREYS, voxel.earlier_misses + _JEFFREYS
    missed = math.lgamma(b + voxel.misses) - math.lgamma(b)
    missed += math.lgamma(a + b) - math.lgamma(a + b + voxel.misses)
    return -missed


@inner_kernel()
def _is_vacant(row: int, seen: SeenVoxels, observed: Observed, belief: Belief) -> bool:
    """Return whether the surface of a voxel is more probably gone than there."""
    voxel = observed.voxels[row]
    odds = max(belief.vacant - belief.stray * voxel.scans, belief.leaves) + _missed(voxel)
    beside = 0.0
    near = rows_around(row, 1, seen, observed)
    since = voxel.missed_since if voxel.misses > 0 else np.int32(1 << 30)
    for other in near:
        one = observed.voxels[other]
        if one.misses > 0 and one.missed_since > voxel.hit_scan:
            since = min(since, one.missed_since)
    for other in near:
        one = observed.voxels[other]
        if other == row:
            continue
        if one.misses > 0:
            if one.missed_since > voxel.hit_scan:
                beside += belief.around * min(_missed(one), belief.most)
        elif one.hit_scan >= since:
            beside -= belief.around * belief.most
    return bool(odds + max(beside, -belief.most) > 0)


@inner_kernel()
def _take_back(
    row: int, seen: SeenVoxels, observed: Observed, taken: list[Voxel], waiting: list[int]
) -> None:
    """Clear the surface bit of a row, whose support begins again, and add its voxel to ``taken``.

    Those next to it that were not hit since are added to ``waiting``.
    """
    voxel = observed.voxels[row]
    x, y, z = voxel_of(row, seen, observed)
    taken.append((x, y, z))
    seen.surface[voxel.owner >> (3 * SHIFT), byte_of(x, y)] &= ~bit_of(z)
    forget_ends(voxel)
    since = max(voxel.passed_scan, voxel.hit_scan + 1)
    for near in rows_around(row, 1, seen, observed):
        if observed.voxels[near].hit_scan < since:
            waiting.append(near)


@kernel()
def take_back(passed: Ints, seen: SeenVoxels, observed: Observed, belief: Belief) -> Longs:
    """Remove the surface of voxels that are contradicted; returns them [M, 3].

    That of the rows ``passed``, by rays of the newest scan, may be. After each removal, those next
    to it are checked once more.
    """
    taken = [voxel_of(0, seen, observed) for _ in range(0)]
    waiting = [np.int64(row) for row in passed]
    while len(waiting):
        row = waiting.pop()
        if has_surface(row, seen, observed) and _is_vacant(row, seen, observed, belief):
            _take_back(row, seen, observed, taken, waiting)
    voxels = np.empty((len(taken), 3), np.int64)
    for number, (x, y, z) in enumerate(taken):
        voxels[number, 0], voxels[number, 1], voxels[number, 2] = x, y, z
    return voxels
