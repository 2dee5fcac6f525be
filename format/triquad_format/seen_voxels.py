"""Evidence as a list of voxels."""

import numpy as np
from numpy.typing import NDArray

from triquad_format import morton
from triquad_format.region import BLOCK_VOXELS, Evidence


def seen_voxels(evidence: Evidence, masks: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Voxels [N, 3] of a region whose bit is set in ``masks`` [B, BLOCK_BYTES] of its evidence."""
    bits = np.unpackbits(masks, axis=1, bitorder="little")
    rows, voxel = np.nonzero(bits)
    inner = np.stack(np.unravel_index(voxel, (BLOCK_VOXELS,) * 3), axis=1)
    blocks: NDArray[np.int64] = morton.decode(evidence.codes, 3)[rows] * BLOCK_VOXELS
    return blocks + inner
