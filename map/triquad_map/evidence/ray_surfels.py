"""Surfels as the rays alone show them, where the field has still to learn what they saw."""

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.planes import PLANE
from triquad_map.evidence.normals import NEAREST, find_normal
from triquad_map.evidence.observed import Observed, is_flat, row_of
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.surface import SurfelKind, Surfels, nothing_shown

_RAY_DISC, _RAY_POINT = int(SurfelKind.RAY_DISC), int(SurfelKind.RAY_POINT)


def ray_surfels(
    voxels: Longs, since: int, hit_since: int, seen: SeenVoxels, observed: Observed
) -> Surfels:
    """Return the surfels of ``voxels`` [N, 3]; see :data:`triquad_map.surface.ShownByRays`.

    Only where rays first ended in scan ``since`` or later: of the rest the field has learnt.
    """
    surfels = nothing_shown(voxels)
    shown = (surfels.offsets, surfels.normals, surfels.kinds)
    _fill(voxels, since, hit_since, seen, observed, *shown)
    return surfels


@inner_kernel()
def _set_normal(
    row: int, since: int, seen: SeenVoxels, observed: Observed, normal: Doubles
) -> bool:
    """Set the normal of the surface in a voxel, to the sensor; False: it is the way there."""
    voxel = observed.voxels[row]
    towards = voxel.towards
    for axis in range(3):
        normal[axis] = voxel.normal[axis]
    # Others may have ended around since its own was looked for.
    is_known = is_flat(voxel)
    if not is_known:
        is_known = find_normal(row, NEAREST, since, seen, observed, normal) == PLANE
    if not is_known:
        length = max(np.sqrt(_product(towards, towards)), 1e-6)
        for axis in range(3):
            normal[axis] = towards[axis] / length
        return False
    if _product(normal, towards) < 0:
        for axis in range(3):
            normal[axis] = -normal[axis]
    return True


@inner_kernel()
def _product(one: Floats | Doubles, other: Floats) -> float:
    """Return the scalar product of two vectors [3]."""
    product: float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product


@kernel()
def _fill(
    voxels: Longs,
    since: int,
    hit_since: int,
    seen: SeenVoxels,
    observed: Observed,
    offsets: Floats,
    normals: Floats,
    kinds: Bytes,
) -> None:
    normal = np.zeros(3)
    for i in range(len(voxels)):
        row = row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])
        here = observed.voxels[row]
        if row == 0 or here.ends == 0 or here.first_scan < since or here.hit_scan < hit_since:
            continue
        is_disc = _set_normal(row, since, seen, observed, normal)
        kinds[i] = _RAY_DISC if is_disc else _RAY_POINT
        offsets[i], normals[i] = here.mean - np.float32(0.5), normal
