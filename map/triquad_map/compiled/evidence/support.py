"""The support of each surface voxel by rays: how strong it is, and where in it they ended."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Floats
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.evidence.observed import EIGHTHS, Observed, ObservedVoxel
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.row_access import prefetch_row
from triquad_map.compiled.voxel_index import SHIFT
from triquad_map.surface import LEAST_STRENGTH, LEVELS, SECTORS_COUNTED


class Support(NamedTuple):
    """The support of surface voxels [S] by rays, as kernels take it."""

    levels: Bytes  # [S] how well each is supported
    scans: Bytes  # [S] of which rays ended in it, up to ``MOST_SCANS``
    beyond: Bytes  # [S, 6] quarters of it on each side, at the end of which no ray ended


@kernel(inline="always")
def _level(voxel: ObservedVoxel) -> int:
    """Return the level of a voxel; each scan in a row that contradicts it takes one off."""
    sectors = 0
    for sector in range(8):
        sectors += voxel.sectors >> sector & 1
    strength = voxel.weight * (0.5 + 0.5 * min(SECTORS_COUNTED, max(1, sectors)))
    level = 0
    while level < LEVELS - 1 and strength >= LEAST_STRENGTH * (1 << level):
        level += 1
    return max(min(1, level), level - int(voxel.pass_scans))


@kernel(inline="always")
def _quarters(eighths: int) -> int:
    """Return how many quarters of a voxel stand for as many eighths in which no ray ended.

    They are less by an eighth at least.
    """
    return max(eighths - 1, 0) >> 1


@kernel()
def fill_support(surface: Bytes, observed: Observed, weights: Floats, support: Support) -> None:
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
