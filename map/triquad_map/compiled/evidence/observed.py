"""Observations of each voxel in which rays ended, as kernels take them: a record for each."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Ints, Longs

from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, bit_of, byte_of, find_block, unpack

OBSERVED_VOXEL = np.dtype(
    [
        ("owner", np.int64),  # the block's row in the evidence, and the voxel in the block
        ("mean", np.float32, 3),  # of the ends, voxels, in the voxel
        ("normal", np.float32, 3),  # of the surface; 0 where it is not known or not flat
        ("lowest", np.uint8, 3),  # eighths of the voxel in which any of its rays ended, and
        ("highest", np.uint8, 3),  # the last of these, on each axis
        ("scans", np.uint8),  # of which rays ended on the surface that is there now, to MOST_SCANS
        ("towards", np.float32, 3),  # from the last end to the sensor, voxels
        ("spread", np.float32),  # mean squared distance of the ends from their mean, voxels
        ("ends", np.float32),  # rays that ended on the surface that is there now, up to a limit
        ("weight", np.float32),  # these rays, the near ones counting more
        ("sectors", np.int32),  # a bit for each eighth of the horizon it was seen from
        ("hits", np.int32),  # scans of which rays ended there, whatever surface it was
        ("first_scan", np.int32),  # of which a ray ended on the surface that is there now
        ("hit_scan", np.int32),  # the last of which a ray ended there
        ("passed_scan", np.int32),  # the last of which a ray passed, and none ended there
        ("pass_scans", np.int32),  # such scans in a row
        ("passes", np.int32),  # rays of theirs that passed
        ("misses", np.int32),  # rays of theirs that crossed the surface
        ("earlier_passes", np.int32),  # as these two, before the last hit
        ("earlier_misses", np.int32),
    ],
    align=True,
)

EIGHTHS = 8
MOST_SCANS = 255

ObservedVoxel = Any
"""A record of OBSERVED_VOXEL."""


class Observed(NamedTuple):
    """The arrays of the observations, as kernels take them."""

    places: Ints  # [blocks] where in the next two a block of evidence stands; 0: nothing is known
    rows: Ints  # [places, voxels] the row of each voxel in ``voxels``; 0: no ray ended in it
    seen_s: Longs  # [places] when the last ray ended in the block
    voxels: NDArray[np.void]  # [rows] OBSERVED_VOXEL; row 0 is of none


Voxel = tuple[int, int, int]
Vector = tuple[float, float, float]


@kernel(inline="always")
def forget_ends(voxel: ObservedVoxel) -> None:
    """Forget all rays that ended in a voxel."""
    voxel.weight = voxel.ends = voxel.scans = 0
    voxel.sectors = 0
    for axis in range(3):
        voxel.lowest[axis], voxel.highest[axis] = EIGHTHS - 1, 0


@kernel(inline="always")
def is_flat(voxel: ObservedVoxel) -> bool:
    """Return whether the normal of the surface in a voxel is known."""
    normal = voxel.normal
    return bool(normal[0] != 0 or normal[1] != 0 or normal[2] != 0)


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


@kernel()
def has_surface(row: int, seen: SeenVoxels, observed: Observed) -> bool:
    """Return whether the surface of a row is still believed."""
    owner = observed.voxels[row].owner
    block = owner >> (3 * SHIFT)
    return bool(seen.surface[block, owner >> SHIFT & (1 << (2 * SHIFT)) - 1] & bit_of(owner & LOW))


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
                    of_block = observed.rows[observed.places[block]]
                    count = _add_rows(of_block, corner, middle, reach, rows, count)
    return rows[:count]


@inner_kernel()
def _add_rows(
    of_block: Ints, corner: Voxel, middle: Voxel, reach: int, rows: Ints, count: int
) -> int:
    """Add the rows of a block that :func:`rows_around` asks for; returns how many there are now."""
    (x, y, z), (low_x, low_y, low_z) = middle, corner
    for i in range(max(x - reach, low_x), min(x + reach, low_x + LOW) + 1):
        for j in range(max(y - reach, low_y), min(y + reach, low_y + LOW) + 1):
            column = byte_of(i, j) << SHIFT
            for k in range(max(z - reach, low_z), min(z + reach, low_z + LOW) + 1):
                row = of_block[column | (k & LOW)]
                if row != 0:
                    rows[count] = row
                    count += 1
    return count
