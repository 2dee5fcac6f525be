"""Surfels as the rays alone show them, where the field has still to learn what they saw."""

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Longs

from triquad_map.compiled.evidence.observed import (
    ENDS,
    FIRST_SCAN,
    HIT_SCAN,
    HITS,
    MEAN,
    NORMAL,
    TOWARDS,
    Observed,
    row_of,
)
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.planes import MOMENTS, add_points, plane_normal
from triquad_map.surface import SurfelKind, Surfels, nothing_shown

_RAY_DISC, _RAY_POINT = int(SurfelKind.RAY_DISC), int(SurfelKind.RAY_POINT)

_NEW = 10
"""Scans from the first to the last of which rays ended on a surface: one that was seen for longer
the field has had time to learn."""


def ray_surfels(voxels: Longs, seen: SeenVoxels, observed: Observed) -> Surfels:
    """The surfels of ``voxels`` [N, 3]; see :data:`triquad_map.surface.ShownByRays`."""
    surfels = nothing_shown(voxels)
    _fill(voxels, seen, observed, surfels.offsets, surfels.normals, surfels.kinds)
    return surfels


@kernel()
def _normal_around(
    voxel: Longs, row: int, seen: SeenVoxels, observed: Observed, normal: Doubles
) -> bool:
    """The normal of the ends in a voxel and those around it; False where they are not flat.

    Only those count that rays have ended in since they did here, and not much more often: a floor
    does not, on which something was put.
    """
    hits = observed.counts[row, HITS]
    since, most = observed.counts[row, HIT_SCAN] - hits, 2 * hits + 1
    moments = np.zeros(MOMENTS)
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                near = row_of(seen, observed, voxel[0] + i, voxel[1] + j, voxel[2] + k)
                shape, counts = observed.shapes[near], observed.counts[near]
                if near == 0 or shape[ENDS] == 0:
                    continue
                if counts[HIT_SCAN] > since and counts[HITS] <= most:
                    at = (i + shape[MEAN], j + shape[MEAN + 1], k + shape[MEAN + 2])
                    add_points(moments, at, shape[ENDS])
    return bool(plane_normal(moments, normal))


@kernel()
def _set_normal(
    voxel: Longs, row: int, seen: SeenVoxels, observed: Observed, normal: Doubles
) -> bool:
    """Set the normal of the surface in a voxel, to the sensor; False: it is the way there."""
    shape = observed.shapes[row]
    towards = shape[TOWARDS : TOWARDS + 3]
    normal[:] = shape[NORMAL : NORMAL + 3]
    if not normal.any() and not _normal_around(voxel, row, seen, observed, normal):
        normal[:] = towards / max(np.sqrt((towards * towards).sum()), 1e-6)
        return False
    if (normal * towards).sum() < 0:
        normal *= -1
    return True


@kernel()
def _fill(
    voxels: Longs,
    seen: SeenVoxels,
    observed: Observed,
    offsets: Floats,
    normals: Floats,
    kinds: Bytes,
) -> None:
    normal = np.zeros(3)
    for i in range(len(voxels)):
        row = row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])
        shape = observed.shapes[row]
        age = observed.counts[row, HIT_SCAN] - observed.counts[row, FIRST_SCAN]
        if row == 0 or shape[ENDS] == 0 or age > _NEW:
            continue
        is_flat = _set_normal(voxels[i], row, seen, observed, normal)
        kinds[i] = _RAY_DISC if is_flat else _RAY_POINT
        offsets[i], normals[i] = shape[MEAN : MEAN + 3] - np.float32(0.5), normal
