"""Surfels as the rays alone show them, where the field has still to learn what they saw."""

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.evidence.observed import Observed, ObservedVoxel, is_flat, row_of
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
def _set_normal(voxel: ObservedVoxel, normal: Doubles) -> None:
    """Set the normal of the surface in a voxel, to the sensor; if none is known, the way there."""
    towards = voxel.towards
    length = max(np.sqrt(_product(towards, towards)), 1e-6)
    sign = -1.0 if _product(voxel.normal, towards) < 0 else 1.0
    for axis in range(3):
        is_known = is_flat(voxel)
        normal[axis] = sign * voxel.normal[axis] if is_known else towards[axis] / length


@inner_kernel()
def _product(one: Floats, other: Floats) -> float:
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
        _set_normal(here, normal)
        kinds[i] = _RAY_DISC if is_flat(here) else _RAY_POINT
        offsets[i], normals[i] = here.mean - np.float32(0.5), normal
