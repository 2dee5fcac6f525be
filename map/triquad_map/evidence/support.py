"""The support of each surface voxel by rays: how strong it is, and where in the voxel they ended.

A surface may end within a voxel, at the corner of a house or where no sensor saw any farther. How
many quarters of a voxel on each of its sides lie beyond all ends shows where: they are its margins,
as files have them. A margin counts only where the surface does not go on beyond that side: in
between, few rays leave gaps. And it counts only where rays would have ended in it: by as many scans
as hit the voxel, or one next to it.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES, surface_counts, used_blocks

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.lanes import prefetch_row
from triquad_map.compiled.team import Split
from triquad_map.compiled.voxel_index import LOW, SHIFT, byte_of, find_block, is_set, unpack
from triquad_map.evidence.observed import EIGHTHS, Observed, ObservedVoxel, Voxel
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.surface import LEAST_STRENGTH, LEVELS, MARGIN_STEP


class Support(NamedTuple):
    """The support of surface voxels [S] by rays, as kernels take it."""

    levels: Bytes  # [S] how well each is supported
    scans: Bytes  # [S] of which rays ended in it, up to ``MOST_SCANS``
    beyond: Bytes  # [S, 6] quarters of it on each side, at the end of which no ray ended


@kernel(inline="always")
def _level(voxel: ObservedVoxel) -> int:
    """Return the level of a voxel; each scan in a row that contradicts it takes one off.

    Each further eighth of the horizon from which it was seen counts half as much as the first.
    """
    sectors = 0
    for sector in range(8):
        sectors += voxel.sectors >> sector & 1
    strength = voxel.weight * 0.5 * (1 + sectors)
    level = 0
    while level < LEVELS - 1 and strength >= LEAST_STRENGTH * (1 << level):
        level += 1
    return max(min(1, level), level - int(voxel.misses + 0.5))


@kernel(inline="always")
def _quarters(eighths: int) -> int:
    """Return how many quarters of a voxel stand for as many eighths in which no ray ended.

    They are less by an eighth at least.
    """
    return max(eighths - 1, 0) >> 1


@kernel()
def _fill_support(surface: Bytes, observed: Observed, weights: Floats, support: Support) -> None:
    """Fill in the ``support`` of the voxels of ``surface``, in their order.

    ``weights`` [rows, 1] are those of the records in ``observed``, which lie all over the memory.
    """
    at = 0
    rows = np.empty(BLOCK_BYTES * BLOCK_VOXELS, np.int32)
    for block in range(len(surface)):
        place = observed.places[block]
        count = 0
        for byte in range(BLOCK_BYTES):
            bits = int(surface[block, byte])
            if bits == 0:
                continue
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    rows[count] = observed.rows[place, byte << SHIFT | z]
                    prefetch_row(weights, rows[count])
                    count += 1
        for row in rows[:count]:
            voxel = observed.voxels[row]
            support.levels[at] = _level(voxel)
            support.scans[at] = voxel.scans
            for axis in range(3):
                above = EIGHTHS - 1 - voxel.highest[axis]
                support.beyond[at, axis] = _quarters(voxel.lowest[axis])
                support.beyond[at, axis + 3] = _quarters(above)
            at += 1


def surface_support(surface: Bytes, observed: Observed, split: Split) -> Support:
    """Return the support of each voxel set in ``surface`` [blocks, BLOCK_BYTES], in order."""
    used = used_blocks(surface)
    surface, places = surface[used], observed.places[used]
    starts = np.concatenate([[0], np.cumsum(surface_counts(surface))])
    count = int(starts[-1])
    beyond = np.empty((count, _SIDES), np.uint8)
    support = Support(np.empty(count, np.uint8), np.empty(count, np.uint8), beyond)
    weights = observed.voxels["weight"][:, None]

    def work(first: int, last: int) -> None:
        part = Support(*(array[starts[first] : starts[last]] for array in support))
        of_blocks = observed._replace(places=places[first:last])
        _fill_support(surface[first:last], of_blocks, weights, part)

    split(len(surface), work, least=_LEAST_BLOCKS)
    return support


_SIDES = 6
_LEAST_BLOCKS = 64  # whose support a thread of its own finds sooner
_MARGINS = 4  # from 0 on

_CHANCE = 0.1
"""A margin counts where the chance is less that all scans missed a surface that goes on."""

_BEYOND = np.array([[1 << axis, 0, 8 << axis] for axis in range(3)])
"""The bit of the side on which a voxel is next to another: less, level or greater, by axis."""

_BITS_SET = np.array([byte.bit_count() for byte in range(256)], np.uint8)

_LEAST_SCANS = np.array(
    # A margin begins half a step earlier than its number says.
    [math.ceil(math.log(_CHANCE) / math.log(1 - MARGIN_STEP * (m + 0.5))) for m in range(_MARGINS)]
)
"""The number of scans that would have hit a surface that goes on, by the margin."""

Scans = NDArray[np.int16]


@inner_kernel()
def _add_block(
    row: int, shift: Voxel, seen: SeenVoxels, firsts: Longs, scans: Bytes, around: Scans
) -> None:
    """Add the voxels of a block that is ``shift`` blocks from the one in ``around``."""
    number = firsts[row]
    for byte in range(BLOCK_BYTES):
        bits = int(seen.surface[row, byte])
        x = (byte >> SHIFT) + shift[0] * BLOCK_VOXELS + 1
        y = (byte & LOW) + shift[1] * BLOCK_VOXELS + 1
        if bits != 0 and 0 <= x < len(around) and 0 <= y < len(around):
            at = number
            for inner in range(BLOCK_VOXELS):
                if bits >> inner & 1:
                    z = inner + shift[2] * BLOCK_VOXELS + 1
                    if 0 <= z < len(around):
                        around[x, y, z] = 1 + scans[at]
                    at += 1
        number += _BITS_SET[bits]


@inner_kernel()
def _fill_around(row: int, seen: SeenVoxels, firsts: Longs, scans: Bytes, around: Scans) -> None:
    """Fill in a block's voxels and those next to it: scans and 1; 0: no surface."""
    around[:] = 0
    x, y, z = unpack(seen.blocks.row_keys[row])
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                corner = ((x + i) << SHIFT, (y + j) << SHIFT, (z + k) << SHIFT)
                near = find_block(seen.blocks, corner[0], corner[1], corner[2], seen.side)
                if near >= 0:
                    _add_block(near, (i, j, k), seen, firsts, scans, around)


@inner_kernel()
def _look_around(voxel: Voxel, around: Scans) -> tuple[int, int]:
    """Return the most scans that hit a voxel or one next to it, and where surface goes on.

    A bit for each side says whether any of the nine voxels beyond it has surface.
    """
    most = goes_on = 0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                known = int(around[voxel[0] + i - 1, voxel[1] + j - 1, voxel[2] + k - 1])
                if known > 0:
                    most = max(most, known - 1)
                    goes_on |= _BEYOND[0, i] | _BEYOND[1, j] | _BEYOND[2, k]
    return most, goes_on


@inner_kernel()
def _fill_margins(voxel: Voxel, beyond: Bytes, around: Scans, margins: Bytes) -> None:
    """Fill in the ``margins`` [6] of a voxel, whose place in ``around`` is given."""
    scans, goes_on = _look_around(voxel, around)
    for side in range(_SIDES):
        if not goes_on >> side & 1 and scans >= _LEAST_SCANS[beyond[side]]:
            margins[side] = beyond[side]


@kernel()
def margins_that_count(seen: SeenVoxels, firsts: Longs, scans: Bytes, beyond: Bytes) -> Bytes:
    """Return the margins [S, 6] of all surface voxels; 0: none counts.

    ``firsts`` [B] are the numbers of the first surface voxel of each block; ``scans`` [S] and
    ``beyond`` [S, 6] are as of :class:`Support`.
    """
    margins = np.zeros((len(beyond), _SIDES), np.uint8)
    side = BLOCK_VOXELS + 2
    around = np.zeros((side, side, side), np.int16)
    for row in range(len(seen.surface)):
        number = firsts[row]
        known = False  # what lies around
        for byte in range(BLOCK_BYTES):
            bits = int(seen.surface[row, byte])
            for inner in range(BLOCK_VOXELS if bits else 0):
                if not bits >> inner & 1:
                    continue
                if not known:
                    _fill_around(row, seen, firsts, scans, around)
                    known = True
                voxel = ((byte >> SHIFT) + 1, (byte & LOW) + 1, inner + 1)
                _fill_margins(voxel, beyond[number], around, margins[number])
                number += 1
    return margins


@inner_kernel()
def _number_of(row: int, voxel: Voxel, firsts: Longs, seen: SeenVoxels) -> int:
    """Return the number of a surface voxel, in the block ``row``, among all."""
    last = byte_of(voxel[0], voxel[1])
    number = firsts[row]
    for byte in range(last):
        number += _BITS_SET[seen.surface[row, byte]]
    below = int(seen.surface[row, last]) & (1 << (voxel[2] & LOW)) - 1
    return int(number + _BITS_SET[below])


@inner_kernel()
def _holds(point: Doubles, voxel: Voxel, margins: Bytes) -> bool:
    """Return whether a point near a voxel lies in none of its ``margins`` [6]."""
    for side in range(_SIDES):
        inside = point[side % 3] - voxel[side % 3]
        depth = inside if side < 3 else 1 - inside
        if margins[side] > 0 and depth < margins[side] * MARGIN_STEP:
            return False
    return True


@kernel()
def near_ends(
    points: Doubles, reach: float, seen: SeenVoxels, firsts: Longs, margins: Bytes
) -> Bools:
    """Return whether ``points`` [N, 3] lie within ``reach`` of surface voxels, not in margins.

    All is in voxels. The reach is on each axis, and beyond sides without a margin. ``firsts`` [B]
    are the numbers of the first surface voxel of each block, ``margins`` [S, 6] those that count.
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
                        near[i] = _holds(points[i], voxel, margins[number])
    return near
