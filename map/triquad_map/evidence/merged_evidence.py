"""The evidence of two maps of a region, as one."""

from typing import NamedTuple

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES, MARGIN_BITS, OUTCOME_BITS, Evidence

from triquad_map.evidence.evidence import outcome_codes, outcome_counts


class _Spread(NamedTuple):
    """Evidence in some blocks, with values for each voxel: 0 where there is no surface."""

    surface: Bools  # [B, voxels]
    free: Bytes  # [B, BLOCK_BYTES]
    levels: Bytes  # [B, voxels]
    outcomes: Bytes  # [B, voxels, 3]
    margins: Bytes  # [B, voxels, 6]
    seen_s: Longs  # [B]


def merged_evidence(first: Evidence, second: Evidence, removed: Longs) -> Evidence:
    """Return the evidence of both; the outcomes of rays add up.

    ``removed`` [N, 3] are voxels in which the first has a surface that is there no more.
    """
    codes = np.union1d(first.codes, second.codes)
    one, other = _spread(first, codes), _spread(second, codes)
    gone = _mask(removed, codes) & ~other.surface
    both = one.surface & other.surface
    surface = (one.surface | other.surface) & ~gone
    counts = outcome_counts(one.outcomes[both]) + outcome_counts(other.outcomes[both])
    outcomes, margins = one.outcomes | other.outcomes, one.margins | other.margins
    outcomes[both] = outcome_codes(counts)
    margins[both] = np.minimum(one.margins[both], other.margins[both])
    masks = np.packbits(surface, axis=1, bitorder="little")
    free = one.free | other.free
    used = np.flatnonzero((masks | free).any(axis=1))
    newest_s = np.where(surface.any(axis=1), np.maximum(one.seen_s, other.seen_s), 0)
    return Evidence(
        codes[used],
        masks[used],
        free[used],
        levels=np.maximum(one.levels, other.levels)[surface],
        seen_s=newest_s[used],
        outcomes=outcomes[surface],
        margins=margins[surface],
    )


def _spread(evidence: Evidence, codes: Longs) -> _Spread:
    """Return evidence in blocks of these codes, which include its own."""
    rows, blocks = np.searchsorted(codes, evidence.codes), len(codes)
    surface, free = np.zeros((2, blocks, BLOCK_BYTES), np.uint8)
    surface[rows], free[rows] = evidence.surface, evidence.free
    ended = np.unpackbits(surface, axis=1, bitorder="little").astype(np.bool_)
    levels = np.zeros(ended.shape, np.uint8)
    outcomes = np.zeros((*ended.shape, len(OUTCOME_BITS)), np.uint8)
    margins = np.zeros((*ended.shape, len(MARGIN_BITS)), np.uint8)
    levels[ended], outcomes[ended] = evidence.levels, evidence.outcomes
    margins[ended] = evidence.margins
    seen_s = np.zeros(blocks, np.int64)
    seen_s[rows] = evidence.seen_s
    return _Spread(ended, free, levels, outcomes, margins, seen_s)


def _mask(voxels: Longs, codes: Longs) -> Bools:
    """Return which voxels [B, voxels] of blocks with these codes are among some [N, 3]."""
    mask = np.zeros((len(codes), BLOCK_VOXELS**3), np.bool_)
    rows = np.searchsorted(codes, morton.encode(voxels // BLOCK_VOXELS))
    mask[rows, np.ravel_multi_index(tuple((voxels % BLOCK_VOXELS).T), (BLOCK_VOXELS,) * 3)] = True
    return mask
