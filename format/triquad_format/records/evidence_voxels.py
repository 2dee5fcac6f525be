"""Evidence voxel by voxel."""

import numpy as np
from numpy.typing import NDArray

from triquad_format.records import morton
from triquad_format.records.leaf_box import LeafBox
from triquad_format.records.region import BLOCK_VOXELS, Evidence

_BITS_SET = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype="u1")

_REACH_VOXELS = 0.5
"""A point is near a surface where one was seen this far away."""


def seen_voxels(evidence: Evidence, masks: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Voxels [N, 3] of a region whose bit is set in ``masks`` [B, BLOCK_BYTES] of its evidence."""
    bits = np.unpackbits(masks, axis=1, bitorder="little")
    rows, voxel = np.nonzero(bits)
    inner = np.stack(np.unravel_index(voxel, (BLOCK_VOXELS,) * 3), axis=1)
    blocks: NDArray[np.int64] = morton.decode(evidence.codes, 3)[rows] * BLOCK_VOXELS
    return blocks + inner


def status_voxels(evidence: Evidence, box: LeafBox) -> NDArray[np.uint8]:
    """Bits [B, BLOCK_BYTES] of the voxels that decide the status in a box."""
    first = morton.decode(evidence.codes, 3) * BLOCK_VOXELS
    voxels = first[:, :, None] + np.arange(BLOCK_VOXELS)  # [B, 3, 8]
    low, high = box.low - _REACH_VOXELS, box.high + _REACH_VOXELS
    inside = (voxels + 1 >= low[:, None]) & (voxels <= high[:, None])
    columns = inside[:, 0, :, None] & inside[:, 1, None, :]  # [B, x, y]
    heights = np.packbits(inside[:, 2], axis=1, bitorder="little")  # [B, 1]
    mask = np.where(columns.reshape(len(columns), BLOCK_VOXELS**2), heights, 0)
    return mask.astype(np.uint8)


def surface_counts(surface: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Numbers [B] of surface voxels in blocks with these masks [B, BLOCK_BYTES]."""
    counts: NDArray[np.int64] = _BITS_SET[surface].sum(axis=1, dtype=np.int64)
    return counts


def masked(evidence: Evidence, mask: NDArray[np.uint8]) -> Evidence:
    """The evidence of the voxels whose bit is set in ``mask`` [B, BLOCK_BYTES]."""
    surface, free = evidence.surface & mask, evidence.free & mask
    rows = np.flatnonzero((surface | free).any(axis=1))
    levels, seen_s = evidence.levels, evidence.seen_s
    if levels is not None:
        before, after = (
            np.unpackbits(bits, bitorder="little").astype(bool)
            for bits in (evidence.surface, surface)
        )
        levels = levels[after[before]]
    if seen_s is not None:
        seen_s = np.where(surface.any(axis=1), seen_s, 0)[rows]
    return Evidence(evidence.codes[rows], surface[rows], free[rows], levels=levels, seen_s=seen_s)
