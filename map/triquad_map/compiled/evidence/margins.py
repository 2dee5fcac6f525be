"""In which part of a surface voxel rays ended: its margins, as files tell them.

A surface may end within a voxel, at the corner of a house or where nobody looked any farther. How
many quarters of a voxel on each of its sides lie beyond all ends tells where. A margin counts only
where the surface does not go on beyond that side: in between, few rays leave gaps. And it counts
only where rays would have ended in it: by as many scans as hit the voxel, or one beside it.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs

from triquad_map.compiled.evidence.observed import Voxel
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, byte_of, find_block, is_set
from triquad_map.surface import MARGIN_STEP

_SIDES = 6

_CHANCE = 0.1
"""A margin counts where the chance is less that all scans missed a surface that goes on."""


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


class SeenMargins(NamedTuple):
    """The margins of all surface voxels, and what tells whether they count, as kernels take it."""

    seen: SeenVoxels
    firsts: Longs  # [B] number of the first surface voxel of each block
    hits: Bytes  # [S] scans of which rays ended in each voxel
    margins: Bytes  # [S, 6]


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
def _most_hits(voxel: Voxel, known: SeenMargins) -> int:
    """Scans that hit a voxel or one of those around it, whichever was hit most."""
    seen, most = known.seen, 0
    for x in range(voxel[0] - 1, voxel[0] + 2):
        for y in range(voxel[1] - 1, voxel[1] + 2):
            for z in range(voxel[2] - 1, voxel[2] + 2):
                row = find_block(seen.blocks, x, y, z, seen.side)
                if row >= 0 and is_set(seen.surface, row, x, y, z):
                    number = _number_of(row, (x, y, z), known.firsts, seen)
                    most = max(most, int(known.hits[number]))
    return most


@kernel(inline="always")
def _is_sure(margin: int, hits: int) -> bool:
    """Whether so many scans would have hit a surface that goes on in a margin."""
    left = 1 - MARGIN_STEP * (margin + 0.5)  # of the voxel: the margin begins so much earlier
    return bool(left**hits < _CHANCE)


@kernel()
def _holds(point: Doubles, voxel: Voxel, number: int, known: SeenMargins) -> bool:
    """Whether a point near a voxel lies in none of its margins that count."""
    for side in range(_SIDES):
        margin = known.margins[number, side]
        inside = point[side % 3] - voxel[side % 3]
        depth = inside if side < 3 else 1 - inside
        if margin == 0 or depth >= margin * MARGIN_STEP or _goes_on(voxel, side, known.seen):
            continue
        if _is_sure(margin, _most_hits(voxel, known)):
            return False
    return True


@kernel()
def near_ends(points: Doubles, reach: float, known: SeenMargins) -> Bools:
    """Whether ``points`` [N, 3] lie within ``reach`` of surface voxels, and not in their margins.

    All is in voxels. The reach is on each axis, and beyond sides without a margin.
    """
    near = np.zeros(len(points), np.bool_)
    seen = known.seen
    for i in range(len(points)):
        x0, y0, z0 = np.floor(points[i] - reach)
        x1, y1, z1 = np.floor(points[i] + reach)
        for x in range(int(x0), int(x1) + 1):
            for y in range(int(y0), int(y1) + 1):
                for z in range(int(z0), int(z1) + 1):
                    row = -1 if near[i] else find_block(seen.blocks, x, y, z, seen.side)
                    if row >= 0 and is_set(seen.surface, row, x, y, z):
                        voxel = (x, y, z)
                        number = _number_of(row, voxel, known.firsts, seen)
                        near[i] = _holds(points[i], voxel, number, known)
    return near


@kernel()
def margins_that_count(voxels: Longs, numbers: Longs, known: SeenMargins) -> Bytes:
    """The margins [S, 6] of ``voxels`` [S, 3], whose ``numbers`` [S] are known; 0: none counts."""
    told = np.zeros((len(voxels), _SIDES), np.uint8)
    for i in range(len(voxels)):
        voxel = (voxels[i, 0], voxels[i, 1], voxels[i, 2])
        hits = -1  # until a margin needs it
        for side in range(_SIDES):
            margin = known.margins[numbers[i], side]
            if margin == 0 or _goes_on(voxel, side, known.seen):
                continue
            hits = _most_hits(voxel, known) if hits < 0 else hits
            if _is_sure(margin, hits):
                told[i, side] = margin
    return told
