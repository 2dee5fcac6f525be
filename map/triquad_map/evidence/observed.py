"""Observations of each voxel in which rays ended: a record for each, and which are around it."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Ints, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import (
    LOW,
    SHIFT,
    byte_of,
    find_block,
    unpack,
)
from triquad_map.evidence.seen_voxels import SeenVoxels

OBSERVED_VOXEL = np.dtype(
    [
        ("owner", np.int64),  # the block's row in the evidence, and the voxel in the block
        ("mean", np.float32, 3),  # of the ends, voxels, in the voxel
        ("ends", np.float32),  # rays that ended on the surface that is there now, up to a limit
        ("first_scan", np.int32),  # of which a ray ended on the surface that is there now
        ("normal", np.float32, 3),  # of the surface; 0 where it is not known or not flat
        ("lowest", np.uint8, 3),  # eighths of the voxel in which any of its rays ended, and
        ("highest", np.uint8, 3),  # the last of these, on each axis
        ("scans", np.uint8),  # of which rays ended on the surface that is there now, to MOST_SCANS
        ("company", np.bool_),  # others of its scan told that a ray ended on a surface there
        ("towards", np.float32, 3),  # from the last end to the sensor, voxels
        ("spread", np.float32, 6),  # covariance of the ends, voxels: xx, xy, xz, yy, yz, zz
        ("weight", np.float32),  # these rays, the near ones counting more
        ("sectors", np.int32),  # a bit for each eighth of the horizon it was seen from
        ("hits", np.float32),  # scans' worth of rays that ended there, to MOST_SEEN with misses
        ("hit_scan", np.int32),  # the last of which a ray ended there
        ("passed_scan", np.int32),  # the last of which a ray may have crossed the surface
        ("missed_since", np.int32),  # the first of these since the last hit
        ("ended", np.float32),  # rays of the scan that hit it last
        ("crossed", np.float32),  # rays of the scan that passed it last, by how surely they crossed
        ("misses", np.float32),  # scans' worth of rays that crossed since the last hit
        ("earlier_misses", np.float32),  # and of those before it
    ],
    align=True,
)

EIGHTHS = 8
MOST_SCANS = 255

SAME_SURFACE = 0.35
"""Standard deviation, in voxels, of the height of a surface over its plane next to it: two things
are two where one is higher over the other."""

MOST_SEEN = np.float32(10)
"""Scans' worth of rays that a record counts: what was seen longer is no surer, so that what stood
for an hour goes as what stood for a minute."""

FILLED = 1 / 12  # square voxels: variance of ends that lie evenly over the side of a voxel

PRIOR_ENDS = 2.0
"""Ends that the shape of a surface counts for that is assumed before any."""

ObservedVoxel = Any
"""A record of OBSERVED_VOXEL."""


class Observed(NamedTuple):
    """The arrays of the observations, as kernels take them."""

    places: Ints  # [blocks] where in the next two a block of evidence stands; 0: nothing is known
    rows: Ints  # [places, voxels] the row of each voxel in ``voxels``; 0: no ray ended in it
    ended: Bytes  # [places, BLOCK_BYTES] bits of these voxels
    seen_s: Longs  # [places] when the last ray ended in the block
    voxels: NDArray[np.void]  # [rows] OBSERVED_VOXEL; row 0 is of none


Voxel = tuple[int, int, int]
Vector = tuple[float, float, float]


@kernel(inline="always")
def forget_ends(voxel: ObservedVoxel) -> None:
    """Forget all rays that ended in a voxel."""
    voxel.weight = voxel.ends = voxel.scans = 0
    voxel.company = False
    voxel.sectors = 0
    for axis in range(3):
        voxel.lowest[axis], voxel.highest[axis] = EIGHTHS - 1, 0


@kernel(inline="always")
def is_flat(voxel: ObservedVoxel) -> bool:
    """Return whether the normal of the surface in a voxel is known."""
    normal = voxel.normal
    return bool(normal[0] != 0 or normal[1] != 0 or normal[2] != 0)


def first_seen_since(scan: int, rows: Ints, observed: Observed) -> Bools:
    """Return which ``rows`` [N] have a surface that was first seen in ``scan`` or later.

    Row 0, outside the region, has none.
    """
    is_new: Bools = observed.voxels["first_scan"][rows] >= scan
    return is_new & (rows > 0)


@kernel(inline="always")
def row_of(seen: SeenVoxels, observed: Observed, x: int, y: int, z: int) -> int:
    """Return the row of a voxel; 0 where no ray ended in it."""
    block = find_block(seen.blocks, x, y, z, seen.side)
    if block < 0:
        return 0
    return int(observed.rows[observed.places[block], byte_of(x, y) << SHIFT | (z & LOW)])


@inner_kernel()
def voxel_of(row: int, seen: SeenVoxels, observed: Observed) -> Voxel:
    """Return the voxel of a row."""
    owner = observed.voxels[row].owner
    x, y, z = unpack(seen.blocks.row_keys[owner >> (3 * SHIFT)])
    return (
        (x << SHIFT) + (owner >> (2 * SHIFT) & LOW),
        (y << SHIFT) + (owner >> SHIFT & LOW),
        (z << SHIFT) + (owner & LOW),
    )


@inner_kernel()
def rows_around(row: int, reach: int, seen: SeenVoxels, observed: Observed) -> Ints:
    """Return the rows of a row's voxel and those up to ``reach`` around it in which rays ended."""
    middle = voxel_of(row, seen, observed)
    x, y, z = middle
    rows = np.empty((2 * reach + 1) ** 3, np.int32)
    count = np.int64(0)
    for i in range((x - reach) >> SHIFT, ((x + reach) >> SHIFT) + 1):
        for j in range((y - reach) >> SHIFT, ((y + reach) >> SHIFT) + 1):
            for k in range((z - reach) >> SHIFT, ((z + reach) >> SHIFT) + 1):
                corner = (i << SHIFT, j << SHIFT, k << SHIFT)
                block = find_block(seen.blocks, corner[0], corner[1], corner[2], seen.side)
                if block >= 0:
                    place = observed.places[block]
                    count = _add_rows(place, corner, middle, reach, observed, rows, count)
    return rows[:count]


@inner_kernel()
def _add_rows(
    place: int, corner: Voxel, middle: Voxel, reach: int, observed: Observed, rows: Ints, count: int
) -> int:
    """Add the rows of a block that :func:`rows_around` asks for; returns how many there are now."""
    (x, y, z), (low_x, low_y, low_z) = middle, corner
    first, last = max(z - reach, low_z) & LOW, min(z + reach, low_z + LOW) & LOW
    for i in range(max(x - reach, low_x), min(x + reach, low_x + LOW) + 1):
        for j in range(max(y - reach, low_y), min(y + reach, low_y + LOW) + 1):
            byte = byte_of(i, j)
            bits = int(observed.ended[place, byte]) >> first
            k = first
            while bits != 0 and k <= last:
                if bits & 1:
                    rows[count] = observed.rows[place, byte << SHIFT | k]
                    count += 1
                bits >>= 1
                k += 1
    return count


class Sighting(NamedTuple):
    """The place and the time of a scan."""

    origin: Doubles  # [3] the sensor, voxels
    leaf_m: float
    stamp_s: int  # seconds since 1970
    scan: int  # its number, from 1 on; that of the next is greater
    unlearnt_since: int = 0  # the first scan of whose surface the field has not learnt all
