"""The distance to surface that the field has still to learn: planes of the surfels around a point.

Near a surfel that rays alone show, the distance is the mean of those to the planes of all surfels
around, the nearer ones counting more: implicit moving least squares (Kolluri 2005), as it is done
for clouds of points with normals. After a drive of 50 scans through a street, before any training,
the F-score of the mesh is 97.8 %, and that of the field alone after 1 million samples 97.1 %.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Floats, Ints

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.lanes import lowest_bit
from triquad_map.compiled.voxel_index import LOW, SHIFT, Index, byte_of, find_row, pack
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.surface import SurfelKind, Surfels, level_confidence

_REACH = 1.5
"""The distance from which on a surfel does not count, in voxels: as far as the corners of the cells
in which the mesh looks for surface."""

_BITS = np.array([bin(byte).count("1") for byte in range(256)])
"""How many bits of a byte are set."""


class RayPlanes(NamedTuple):
    """Surfels by the voxels that they are in, as kernels take them."""

    blocks: Index
    surface: Bytes  # [blocks, BLOCK_BYTES] the voxels that have surfels
    places: Ints  # [blocks] of each block in the next; -1: it has none
    columns: Ints  # [places, BLOCK_BYTES] the first surfel of each column of voxels
    offsets: Floats  # [S, 3] from the voxel's middle, voxels
    normals: Floats  # [S, 3]
    weights: Floats  # [S] how much each counts, by its support; 0: it is no plane
    unlearnt: Bools  # [S] which of them rays alone show


def ray_planes(evidence: FrozenEvidence, starts: Ints, surfels: Surfels) -> RayPlanes | None:
    """Return the planes of ``surfels`` [S]; ``None``: the field has learnt all of them.

    They are those of the voxels in which rays ended; ``starts`` [blocks + 1] are the first of each
    block.
    """
    kinds, surface = surfels.kinds, evidence.surface
    unlearnt = kinds >= SurfelKind.RAY_DISC
    if not unlearnt.any():
        return None
    used = np.diff(starts) > 0
    places = np.where(used, np.cumsum(used) - 1, -1).astype(np.int32)
    counts = _BITS[surface[used]]
    columns = starts[:-1][used, None] + np.cumsum(counts, axis=1) - counts
    is_plane = (kinds == SurfelKind.DISC) | unlearnt
    return RayPlanes(
        evidence.seen.blocks,
        surface,
        places,
        columns.astype(np.int32),
        surfels.offsets,
        surfels.normals,
        np.where(is_plane, level_confidence()[evidence.levels], np.float32(0)),
        unlearnt,
    )


class _Sum(NamedTuple):
    """The weighted sums over the surfels around a point."""

    weights: float
    unlearnt: float  # the weights of what the field has not learnt
    height: float  # over their planes, voxels
    x: float  # of their normals
    y: float
    z: float


@inner_kernel(fastmath=True)
def _with_column(
    total: _Sum,
    at: tuple[float, float, float],
    x: int,
    y: int,
    z: int,
    bits: int,
    first: int,
    chosen: int,
    planes: RayPlanes,
) -> _Sum:
    """Add the ``chosen`` surfels of a column of 8 voxels to a sum."""
    while chosen:
        bit = lowest_bit(chosen)
        chosen &= chosen - 1
        surfel = first + _BITS[bits & ((1 << bit) - 1)]
        offset, normal = planes.offsets[surfel], planes.normals[surfel]
        away_x = at[0] - x - 0.5 - offset[0]
        away_y = at[1] - y - 0.5 - offset[1]
        away_z = at[2] - z - bit - 0.5 - offset[2]
        square = away_x**2 + away_y**2 + away_z**2
        if square >= _REACH**2 or not planes.weights[surfel]:
            continue
        height = away_x * normal[0] + away_y * normal[1] + away_z * normal[2]
        weight = (1 - square / _REACH**2) ** 4 * planes.weights[surfel]
        total = _Sum(
            total.weights + weight,
            total.unlearnt + (weight if planes.unlearnt[surfel] else 0.0),
            total.height + weight * height,
            total.x + weight * normal[0],
            total.y + weight * normal[1],
            total.z + weight * normal[2],
        )
    return total


@inner_kernel(fastmath=True)
def _sum_around(at: tuple[float, float, float], planes: RayPlanes) -> _Sum:
    """Return the sum over the surfels around a point, in leaf coordinates."""
    total = _Sum(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    low_x, high_x = int(np.floor(at[0] - _REACH)), int(np.floor(at[0] + _REACH))
    low_y, high_y = int(np.floor(at[1] - _REACH)), int(np.floor(at[1] + _REACH))
    low_z, high_z = int(np.floor(at[2] - _REACH)), int(np.floor(at[2] + _REACH))
    for i in range(low_x >> SHIFT, (high_x >> SHIFT) + 1):
        for j in range(low_y >> SHIFT, (high_y >> SHIFT) + 1):
            for k in range(low_z >> SHIFT, (high_z >> SHIFT) + 1):
                block = find_row(planes.blocks, pack(i, j, k))
                if block < 0 or planes.places[block] < 0:
                    continue
                columns = planes.columns[planes.places[block]]
                corner = k << SHIFT
                first, last = max(low_z - corner, 0), min(high_z - corner, LOW)
                mask = (2 << last) - (1 << first)
                for x in range(max(low_x, i << SHIFT), min(high_x, (i << SHIFT) + LOW) + 1):
                    for y in range(max(low_y, j << SHIFT), min(high_y, (j << SHIFT) + LOW) + 1):
                        byte = byte_of(x, y)
                        bits = int(planes.surface[block, byte])
                        if bits & mask:
                            total = _with_column(
                                total, at, x, y, corner, bits, columns[byte], bits & mask, planes
                            )
    return total


@kernel(fastmath=True)
def put_planes(
    points: Floats, leaf_m: float, middle: float, planes: RayPlanes, sdf: Floats, gradients: Floats
) -> None:
    """Put the distances to unlearnt surface at ``points`` [N, 3] into ``sdf`` [N], metres.

    Args:
        points: metres from the region's centre.
        leaf_m: side of a voxel.
        middle: leaf coordinate of the centre, on each axis.
        planes: the surfels.
        sdf: what the field says, which stays where it has learnt all that is near.
        gradients: the same of the gradients [N, 3]; [0, 3]: they are not asked for.
    """
    for i in range(len(points)):
        at = (
            points[i, 0] / leaf_m + middle,
            points[i, 1] / leaf_m + middle,
            points[i, 2] / leaf_m + middle,
        )
        total = _sum_around(at, planes)
        if total.unlearnt == 0:
            continue
        share = total.unlearnt / total.weights
        sdf[i] += share * (total.height / total.weights * leaf_m - sdf[i])
        if len(gradients):
            gradients[i, 0] += share * (total.x / total.weights - gradients[i, 0])
            gradients[i, 1] += share * (total.y / total.weights - gradients[i, 1])
            gradients[i, 2] += share * (total.z / total.weights - gradients[i, 2])
