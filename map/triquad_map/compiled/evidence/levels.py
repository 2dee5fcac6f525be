"""How well each surface voxel is supported: the level that answers and files tell of."""

from triquad_format.records.arrays import Bytes
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.evidence.observed import Observed, ObservedVoxel
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import SHIFT
from triquad_map.surface import LEAST_STRENGTH, LEVELS, SECTORS_COUNTED


@kernel(inline="always")
def _level(voxel: ObservedVoxel) -> int:
    """The level of a voxel; each scan in a row that contradicts it takes one off."""
    sectors = 0
    for sector in range(8):
        sectors += voxel.sectors >> sector & 1
    strength = voxel.weight * (0.5 + 0.5 * min(SECTORS_COUNTED, max(1, sectors)))
    level = 0
    while level < LEVELS - 1 and strength >= LEAST_STRENGTH * (1 << level):
        level += 1
    return max(min(1, level), level - int(voxel.pass_scans))


@kernel()
def fill_levels(surface: Bytes, observed: Observed, levels: Bytes) -> None:
    """Fill in the ``levels`` of the voxels of ``surface``."""
    at = 0
    for block in range(len(surface)):
        place = observed.places[block]
        for byte in range(BLOCK_BYTES):
            bits = int(surface[block, byte])
            if bits == 0:
                continue
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    row = observed.rows[place, byte << SHIFT | z]
                    levels[at] = _level(observed.voxels[row])
                    at += 1
