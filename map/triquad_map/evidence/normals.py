"""Normals of surfaces, from the ends of rays in each voxel and those around it.

A single scan does not determine the normal of far ground, where it is a few lines of points; many
scans do. So a voxel's plane is found again whenever twice as many scans have hit it.
"""

import numpy as np
from triquad_format.records.arrays import Doubles, Ints

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.planes import MOMENTS, add_points, plane_normal
from triquad_map.evidence.observed import Observed, is_flat, rows_around, voxel_of
from triquad_map.evidence.seen_voxels import SeenVoxels

_REACHES = (1, 3)
"""How many voxels away ends count: the farther ones where the nearer ones lie in no plane."""

_ON_PLANE = 0.25
"""The height of a point over a plane above which it does not lie on it, in voxels."""


@inner_kernel()
def _find_normal(
    row: int, reach: int, seen: SeenVoxels, observed: Observed, found: Doubles
) -> bool:
    """Find the unit normal [3] of the ends within ``reach`` voxels of a row's; False: none."""
    moments = np.zeros(MOMENTS)
    x, y, z = voxel_of(row, seen, observed)
    for near in rows_around(row, reach, seen, observed):
        other = observed.voxels[near]
        if other.ends == 0:
            continue
        i, j, k = voxel_of(np.int64(near), seen, observed)
        mean, spread, ends = other.mean, other.spread, float(other.ends)
        add_points(moments, (i - x + mean[0], j - y + mean[1], k - z + mean[2]), ends)
        for n in range(6):
            moments[4 + n] += ends * spread[n]
    return bool(plane_normal(moments, found))


@kernel()
def fit_normals(rows: Ints, seen: SeenVoxels, observed: Observed) -> None:
    """Fit the normals of the voxels of ``rows`` [N], each once."""
    normal = np.zeros(3)
    for row in rows:
        known = False
        for reach in _REACHES:
            if not known:
                known = _find_normal(np.int64(row), reach, seen, observed, normal)
        for axis in range(3):
            observed.voxels[row].normal[axis] = normal[axis] if known else 0.0


@kernel()
def outdated(rows: Ints, observed: Observed) -> Ints:
    """Return those of the ``rows`` [N] that have been hit by twice as many scans as at their fit."""
    found = np.empty(len(rows), np.int32)
    count = 0
    for row in rows:
        scans = observed.voxels[row].scans
        if row != 0 and scans & (scans - 1) == 0:
            found[count] = row
            count += 1
    return np.unique(found[:count])


@kernel()
def normals_of(ends: Doubles, rows: Ints, observed: Observed) -> Doubles:
    """Return the normals [N, 3] at ``ends`` [N, 3], voxels, in voxels ``rows`` [N]; NaN: unknown."""
    normals = np.full(ends.shape, np.nan)
    for i, row in enumerate(rows):
        voxel = observed.voxels[row]
        if row == 0 or not is_flat(voxel):
            continue
        height = 0.0
        for axis in range(3):
            offset = ends[i, axis] - np.floor(ends[i, axis]) - voxel.mean[axis]
            height += offset * voxel.normal[axis]
        if abs(height) <= _ON_PLANE:
            for axis in range(3):
                normals[i, axis] = voxel.normal[axis]
    return normals
