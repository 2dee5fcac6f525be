"""Bits of voxels in sparse blocks of 8 x 8 x 8, found with numpy alone."""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.region import BLOCK_VOXELS

_BITS = 21
_MIDDLE = 1 << (_BITS - 1)


class VoxelBlocks:
    """A bit for each voxel of an unbounded lattice; 0 where there is no block."""

    def __init__(self, cells: NDArray[np.int64], masks: NDArray[np.uint8]) -> None:
        """``masks`` [B, BLOCK_BYTES] of the blocks at ``cells`` [B, 3], in units of blocks."""
        keys = _keys(cells)
        self._order = np.argsort(keys)
        self._keys = keys[self._order]
        self._masks = masks

    def rows(self, cells: NDArray[np.int64]) -> NDArray[np.intp]:
        """Rows [N] of the blocks at ``cells`` [N, 3]; -1 where there is none."""
        if not len(self._keys):
            return np.full(len(cells), -1, np.intp)
        wanted = _keys(cells)
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        inside = (np.abs(cells) < _MIDDLE).all(axis=1)
        return np.where(inside & (self._keys[at] == wanted), self._order[at], -1)

    def bits(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """The bits [N, 512] of blocks; voxel (x, y, z) is number ``(x * 8 + y) * 8 + z``."""
        return np.unpackbits(self._masks[rows], axis=1, bitorder="little").astype(np.bool_)

    def holds(self, voxels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the bits of ``voxels`` [N, 3] are set."""
        if not len(self._keys):
            return np.zeros(len(voxels), np.bool_)
        rows = self.rows(voxels // BLOCK_VOXELS)
        inner = voxels % BLOCK_VOXELS
        octets = self._masks[rows, inner[:, 0] * BLOCK_VOXELS + inner[:, 1]]
        return np.asarray((rows >= 0) & (octets >> inner[:, 2] & 1 == 1), np.bool_)


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    x, y, z = (cells + _MIDDLE).T
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z, np.int64)
