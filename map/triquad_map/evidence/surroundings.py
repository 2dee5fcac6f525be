"""The observations of a voxel together with those around it."""

from typing import NamedTuple

import numpy as np

from triquad_map.compiled.kernel import inner_kernel
from triquad_map.evidence.observed import Observed, has_surface, rows_around, voxel_of
from triquad_map.evidence.seen_voxels import SeenVoxels


class Around(NamedTuple):
    """A voxel and those around it in which rays ended, together."""

    known: int  # of those around it
    gone: int  # of these, whose surface is not believed any more
    doubted: int  # of these, that are believed, and that rays passed since
    later: int  # of these, that are believed, were hit later than the voxel and not passed since
    hit_span: int  # scans from the first to the last of those that hit one of them last
    scans: int  # most in a row of which rays passed one of them
    misses: int
    earlier_misses: int
    passes: int
    earlier_passes: int
    hits: int


@inner_kernel()
def seen_around(row: int, reach: int, seen: SeenVoxels, observed: Observed) -> Around:
    """Return what is known of the voxel of a row and those up to ``reach`` around it."""
    known = gone = doubted = later = scans = 0
    first = last = observed.voxels[row].hit_scan
    misses = earlier_misses = passes = earlier_passes = hits = 0
    for near in rows_around(row, reach, seen, observed):
        other = observed.voxels[near]
        scans = max(scans, other.pass_scans)
        first, last = min(first, other.hit_scan), max(last, other.hit_scan)
        misses += other.misses
        earlier_misses += other.earlier_misses
        passes += other.passes
        earlier_passes += other.earlier_passes
        hits += other.hits
        if near == row:
            continue
        known += 1
        if not has_surface(near, seen, observed):
            gone += 1
        elif other.pass_scans > 0:
            doubted += 1
        elif other.hit_scan > observed.voxels[row].hit_scan:
            later += 1
    return Around(
        known,
        gone,
        doubted,
        later,
        last - first,
        scans,
        misses,
        earlier_misses,
        passes,
        earlier_passes,
        hits,
    )


@inner_kernel()
def depth_around(row: int, reach: int, seen: SeenVoxels, observed: Observed) -> float:
    """Return how deep what was seen up to ``reach`` around lies along the last ray to hit it.

    Returns:
        A standard deviation, voxels; infinite where no such ray is known.
    """
    towards = observed.voxels[row].towards
    length = np.sqrt(towards[0] ** 2 + towards[1] ** 2 + towards[2] ** 2)
    if length == 0:
        return np.inf
    x, y, z = voxel_of(row, seen, observed)
    count, total, squares = 0, 0.0, 0.0
    for near in rows_around(row, reach, seen, observed):
        i, j, k = voxel_of(near, seen, observed)
        mean = observed.voxels[near].mean
        along = (i - x + mean[0]) * towards[0]
        along += (j - y + mean[1]) * towards[1]
        along += (k - z + mean[2]) * towards[2]
        count += 1
        total += along / length
        squares += (along / length) ** 2
    return float(np.sqrt(max(squares / count - (total / count) ** 2, 0.0)))
