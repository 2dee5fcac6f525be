"""The outcomes of rays at a surface voxel, as files have them: on a scale of powers of two.

They distinguish a fence, hit and missed by turns, from a wall. A wall has the codes 0: it was hit
often, and hardly a ray passed. So has a voxel of which nothing is known.
"""

import numpy as np
from triquad_format.records.arrays import Bytes, Ints
from triquad_format.records.region import OUTCOME_BITS

_MOST_HITS = 8
"""A longer record is restored as one of this many hits, which new rays outweigh sooner."""

_LEAST_SHARE_LOG2 = -3  # of passes or misses, for each hit: of one in eight; fewer are none
_SHARES = (1 << OUTCOME_BITS[1]) - 1


def outcome_codes(counts: Ints) -> Bytes:
    """Return codes [N, 3] of ``counts`` [N, 3]: hits, and the passes and misses between them."""
    hits = counts[:, :1]
    known = np.maximum(hits, 1)
    log2_hits = np.rint(np.log2(known))
    is_short = (hits > 0) & (log2_hits < np.log2(_MOST_HITS))
    of_hits = np.where(is_short, log2_hits + 1, 0)
    shares = counts[:, 1:] / known
    # What is below the least share rounds to 0 or less.
    log2_shares = np.rint(np.log2(np.maximum(shares, 1e-9))) - _LEAST_SHARE_LOG2
    of_shares = np.clip(log2_shares + 1, 0, _SHARES)
    return np.concatenate([of_hits, of_shares], axis=1).astype(np.uint8)


def outcome_counts(codes: Bytes) -> Ints:
    """Return counts [N, 3] of ``codes`` [N, 3]: hits, and the passes and misses between them."""
    of_hits, of_shares = codes[:, :1].astype(np.float64), codes[:, 1:]
    hits = np.where(of_hits > 0, np.exp2(of_hits - 1), _MOST_HITS)
    shares = np.where(of_shares > 0, np.exp2(of_shares - 1.0 + _LEAST_SHARE_LOG2), 0.0)
    return np.concatenate([hits, hits * shares], axis=1).astype(np.int32)
