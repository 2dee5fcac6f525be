"""In which part of a surface voxel rays ended: its margins, as files tell them.

A surface may end within a voxel, at the corner of a house or where nobody looked any farther. How
many quarters of a voxel on each of its sides lie beyond all ends tells where. A margin counts only
where the surface does not go on beyond that side: in between, few rays leave gaps.
"""

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.evidence.observed import EIGHTHS, Observed, Voxel
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, byte_of, find_block, is_set
from triquad_map.surface import MARGIN_STEP

_SIDES = 6


@kernel()
def fill_margins(surface: Bytes, observed: Observed, margins: Bytes) -> None:
    """Fill in the ``margins`` [S, 6] of the voxels of ``surface``: at least an eighth less."""
    at = 0
    for block in range(len(surface)):
        place = observed.places[block]
        for byte in range(BLOCK_BYTES):
            bits = int(surface[block, byte])
            if bits == 0:
                continue
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    voxel = observed.voxels[observed.rows[place, byte << SHIFT | z]]
                    for axis in range(3):
                        beyond = EIGHTHS - 1 - voxel.highest[axis]
                        margins[at, axis] = max(voxel.lowest[axis] - 1, 0) >> 1
                        margins[at, axis + 3] = max(beyond - 1, 0) >> 1
                    at += 1


@kernel(inline="always")
def _is_surface(x: int, y: int, z: int, seen: SeenVoxels) -> bool:
    row = find_block(seen.blocks, x, y, z, seen.side)
    return row >= 0 and is_set(seen.surface, row, x, y, z) == 1


@kernel()
def _goes_on(voxel: Voxel, side: int, seen: SeenVoxels) -> bool:
    """Whether any of the nine voxels beyond a side of one has surface."""
    axis, away = side % 3, 1 if side >= 3 else -1
    for u in range(-1, 2):
        for v in range(-1, 2):
            if axis == 0:
                x, y, z = voxel[0] + away, voxel[1] + u, voxel[2] + v
            elif axis == 1:
                x, y, z = voxel[0] + u, voxel[1] + away, voxel[2] + v
            else:
                x, y, z = voxel[0] + u, voxel[1] + v, voxel[2] + away
            if _is_surface(x, y, z, seen):
                return True
    return False


@kernel()
def _number_of(row: int, voxel: Voxel, firsts: Longs, seen: SeenVoxels) -> int:
    """The number of a surface voxel, in the block ``row``, among all."""
    last = byte_of(voxel[0], voxel[1])
    number = firsts[row]
    for byte in range(last + 1):
        bits = int(seen.surface[row, byte])
        if byte == last:
            bits &= (1 << (voxel[2] & LOW)) - 1
        while bits:
            bits &= bits - 1
            number += 1
    return int(number)


@kernel()
def _holds(point: Doubles, voxel: Voxel, margins: Bytes, seen: SeenVoxels) -> bool:
    """Whether a point near a voxel is not beyond its ends, on no side beyond which nothing is."""
    for side in range(_SIDES):
        if margins[side] == 0:
            continue
        inside = point[side % 3] - voxel[side % 3]
        depth = inside if side < 3 else 1 - inside
        if depth < margins[side] * MARGIN_STEP and not _goes_on(voxel, side, seen):
            return False
    return True


@kernel()
def near_ends(
    points: Doubles, reach: float, seen: SeenVoxels, firsts: Longs, margins: Bytes
) -> Bools:
    """Whether ``points`` [N, 3] lie within ``reach`` of surface voxels, and not in their margins.

    Args:
        points: in voxels.
        reach: beyond sides without a margin, on each axis.
        seen: the evidence.
        firsts: [B] number of the first voxel of each block among those with surface.
        margins: [S, 6] of all of these.
    """
    near = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        x0, y0, z0 = np.floor(points[i] - reach)
        x1, y1, z1 = np.floor(points[i] + reach)
        for x in range(int(x0), int(x1) + 1):
            for y in range(int(y0), int(y1) + 1):
                for z in range(int(z0), int(z1) + 1):
                    row = -1 if near[i] else find_block(seen.blocks, x, y, z, seen.side)
                    if row >= 0 and is_set(seen.surface, row, x, y, z):
                        voxel = (x, y, z)
                        number = _number_of(row, voxel, firsts, seen)
                        near[i] = _holds(points[i], voxel, margins[number], seen)
    return near


@kernel()
def without_inner(margins: Bytes, voxels: Longs, seen: SeenVoxels) -> Bytes:
    """The margins [S, 6] of ``voxels`` [S, 3], but 0 where the surface goes on."""
    outer = np.zeros_like(margins)
    for i in range(len(voxels)):
        voxel = (voxels[i, 0], voxels[i, 1], voxels[i, 2])
        for side in range(_SIDES):
            if margins[i, side] and not _goes_on(voxel, side, seen):
                outer[i, side] = margins[i, side]
    return outer
