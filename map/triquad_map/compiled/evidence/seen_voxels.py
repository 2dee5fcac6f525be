"""The voxels of a region that rays have shown something of, and how rays mark them.

Kernels stop where the index has no more room; the caller makes room and goes on.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Longs

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import (
    LOW,
    Index,
    bit_of,
    block_key,
    byte_of,
    is_inside,
    make_row,
)

Vector = tuple[float, float, float]

_NO_ROOM = -2


class SeenVoxels(NamedTuple):
    """Bit masks in sparse blocks, as kernels take them."""

    side: int  # of the region, voxels
    blocks: Index
    surface: Bytes  # [blocks, BLOCK_BYTES] a ray ended in the voxel
    free: Bytes  # [blocks, BLOCK_BYTES] a ray passed through the voxel


@kernel()
def mark_ends(
    voxels: Doubles, start: int, seen: SeenVoxels, count: int, new: Longs, found: int
) -> tuple[int, int, int]:
    """Set the bits of the voxels holding points, and collect those that were not set before.

    Returns (points done, blocks in use, voxels collected).
    """
    masks = seen.surface
    for i in range(start, len(voxels)):
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        if not is_inside(x, y, z, seen.side):
            continue
        row = make_row(seen.blocks, count, block_key(x, y, z))
        if row < 0:
            return i, count, found
        count = max(count, row + 1)
        byte, bit = byte_of(x, y), bit_of(z)
        if not masks[row, byte] & bit:
            masks[row, byte] |= bit
            new[found, 0], new[found, 1], new[found, 2] = x, y, z
            found += 1
    return len(voxels), count, found


@kernel(inline="always")
def _crossing(origin: float, direction: float) -> tuple[int, float, float]:
    """Which way a ray steps on an axis, how far apart its crossings are, and how far the first."""
    if direction == 0:
        return 1, np.inf, np.inf
    fraction = origin - np.floor(origin)
    if direction > 0:
        return 1, 1 / direction, (1 - fraction) / direction
    return -1, -1 / direction, -fraction / direction


@kernel(inline="always")
def _inside(origin: float, direction: float, side: int) -> tuple[float, float]:
    """How far along a ray it enters and leaves the region on an axis."""
    if direction == 0:
        return (-np.inf, np.inf) if 0 <= origin <= side else (np.inf, -np.inf)
    a, b = -origin / direction, (side - origin) / direction
    return min(a, b), max(a, b)


@kernel(inline="always")
def _part_inside(at: Vector, way: Vector, length: float, side: int) -> tuple[float, float]:
    """Where the part of a ray begins and ends that lies in the region."""
    enters_x, leaves_x = _inside(at[0], way[0], side)
    enters_y, leaves_y = _inside(at[1], way[1], side)
    enters_z, leaves_z = _inside(at[2], way[2], side)
    first = max(0.0, enters_x, enters_y, enters_z)
    return first, min(length, leaves_x, leaves_y, leaves_z)


@kernel()
def _walk(at: Vector, way: Vector, reach: float, seen: SeenVoxels, count: int) -> int:
    """Set the bits of the voxels on a way (Amanatides and Woo 1987).

    Returns the blocks in use, or ``_NO_ROOM``.
    """
    side, index, _, masks = seen
    x, y, z = int(np.floor(at[0])), int(np.floor(at[1])), int(np.floor(at[2]))
    step_x, apart_x, next_x = _crossing(at[0], way[0])
    step_y, apart_y, next_y = _crossing(at[1], way[1])
    step_z, apart_z, next_z = _crossing(at[2], way[2])
    row = -1
    entered = True  # another block
    travelled = 0.0
    while travelled <= reach:
        if entered:
            row = -1
            if is_inside(x, y, z, side):
                row = make_row(index, count, block_key(x, y, z))
                if row < 0:
                    return _NO_ROOM
                count = max(count, row + 1)
        if row >= 0:
            masks[row, byte_of(x, y)] |= bit_of(z)
        if next_x <= next_y and next_x <= next_z:
            travelled = next_x
            next_x += apart_x
            x += step_x
            entered = (x & LOW) == (0 if step_x > 0 else LOW)
        elif next_y <= next_z:
            travelled = next_y
            next_y += apart_y
            y += step_y
            entered = (y & LOW) == (0 if step_y > 0 else LOW)
        else:
            travelled = next_z
            next_z += apart_z
            z += step_z
            entered = (z & LOW) == (0 if step_z > 0 else LOW)
    return count


@kernel()
def mark_crossed(
    origin: Doubles, ends: Doubles, start: int, stop_short: float, seen: SeenVoxels, count: int
) -> tuple[int, int]:
    """Set the bits of the voxels that rays cross, each ``stop_short`` voxels less than its length.

    Returns (rays done, blocks in use).
    """
    at = (origin[0], origin[1], origin[2])
    for i in range(start, len(ends)):
        dx, dy, dz = ends[i, 0] - at[0], ends[i, 1] - at[1], ends[i, 2] - at[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= stop_short:
            continue
        way = (dx / length, dy / length, dz / length)
        first, last = _part_inside(at, way, length - stop_short, seen.side)
        if first > last:
            continue
        begin = (at[0] + first * way[0], at[1] + first * way[1], at[2] + first * way[2])
        used = _walk(begin, way, last - first, seen, count)
        if used == _NO_ROOM:
            return i, count
        count = used
    return len(ends), count
