"""Observations of each voxel in which rays ended: how often, from where, and what became of it.

Files have the outcomes of rays at a voxel on a scale of powers of two, which distinguishes a fence,
hit and missed by turns, from a wall. A wall has the codes 0: it was hit often, and hardly a ray
passed. So has a voxel of which nothing is known.
"""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bytes, Doubles, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import (
    BLOCK_BYTES,
    MARGIN_BITS,
    OUTCOME_BITS,
    surface_counts,
    used_blocks,
)

from triquad_map.compiled.team import Split
from triquad_map.compiled.voxel_index import SHIFT, with_room
from triquad_map.evidence.ended_rays import record_ends
from triquad_map.evidence.observed import (
    EIGHTHS,
    MOST_SCANS,
    OBSERVED_VOXEL,
    Observed,
    Sighting,
)
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.evidence.support import Support, fill_support
from triquad_map.surface import LEAST_STRENGTH

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


_VOXELS = BLOCK_VOXELS**3
_MIN_CAPACITY = 64
_MIN_ROWS = 1024
_LEAST_BLOCKS = 64  # whose support a thread of its own finds sooner
_RECORD = ("hits", "earlier_misses", "earlier_misses")
"""The fields of a voxel's record that files keep; passes are none but those that would have hit."""


class Observations:
    """The observations of the blocks of some evidence, by their rows."""

    def __init__(self, blocks: int) -> None:
        """Make room for ``blocks`` blocks."""
        self._places = 1  # in use
        self._rows = 1
        self.arrays = _arrays(blocks, _MIN_CAPACITY, _MIN_ROWS)

    @property
    def blocks(self) -> int:
        """Blocks in which rays ended."""
        return self._places - 1

    @property
    def voxels(self) -> int:
        """Voxels in which rays ended."""
        return self._rows - 1

    def make_room(self, blocks: int) -> None:
        """Make room for ``blocks`` blocks."""
        places = with_room(self.arrays.places, blocks)
        self.arrays = self.arrays._replace(places=places)

    def record(
        self,
        voxels: Doubles,
        done: int,
        seen: SeenVoxels,
        blocks: int,
        sighting: Sighting,
        found: Ints,
    ) -> tuple[int, int]:
        """Count rays that ended at ``voxels`` [N, 3], some of which are ``done``.

        The row of each ray's voxel goes to ``found`` [N]; 0 outside the region. Returns (rays done,
        blocks in use); where ``seen`` has no more room, not all are done.
        """
        arrays = self.arrays
        done, blocks, self._places, self._rows = record_ends(
            voxels, done, seen, blocks, sighting, arrays, self._places, self._rows, found
        )
        self._grow()
        return done, blocks

    def support(self, surface: Bytes, split: Split) -> Support:
        """Return the support of each voxel set in ``surface`` [blocks, BLOCK_BYTES], in order."""
        used = used_blocks(surface)
        surface, places = surface[used], self.arrays.places[used]
        starts = np.concatenate([[0], np.cumsum(surface_counts(surface))])
        count = int(starts[-1])
        beyond = np.empty((count, len(MARGIN_BITS)), np.uint8)
        support = Support(np.empty(count, np.uint8), np.empty(count, np.uint8), beyond)
        weights = self.arrays.voxels["weight"][:, None]

        def work(first: int, last: int) -> None:
            observed = self.arrays._replace(places=places[first:last])
            part = Support(*(array[starts[first] : starts[last]] for array in support))
            fill_support(surface[first:last], observed, weights, part)

        split(len(surface), work, least=_LEAST_BLOCKS)
        return support

    def outcomes(self, surface: Bytes) -> Bytes:
        """Return codes [S, 3] of the outcomes of rays at voxels set in ``surface``, in order."""
        used = used_blocks(surface)
        ended = np.unpackbits(surface[used], axis=1, bitorder="little").astype(np.bool_)
        rows = self.arrays.rows[self.arrays.places[used]][ended]
        voxels = self.arrays.voxels
        return outcome_codes(np.stack([voxels[name][rows] for name in _RECORD], axis=1))

    def seen_s(self, blocks: int) -> Longs:
        """Return when rays last ended in each of the first ``blocks``, s since 1970; 0: never."""
        return self.arrays.seen_s[self.arrays.places[:blocks]]

    def forget(self, blocks: NDArray[np.intp], surface: Bytes) -> None:
        """Forget, in the rows ``blocks`` [N], voxels that are not set in ``surface`` any more."""
        places = self.arrays.places[blocks]
        kept = np.unpackbits(surface[blocks], axis=1, bitorder="little")
        self.arrays.rows[places] *= kept
        self.arrays.ended[places] &= surface[blocks]

    @classmethod
    def restore(
        cls,
        surface: Bytes,
        levels: Bytes,
        seen_s: Longs,
        *,
        margins: Bytes,
        outcomes: Bytes,
    ) -> "Observations":
        """Return observations of blocks ``surface`` [blocks, BLOCK_BYTES] that give these levels.

        They give ``margins`` [S, 6], too. ``outcomes`` are codes [S, 3] of what became of rays.
        """
        used = used_blocks(surface)
        places = slice(1, 1 + len(used))
        ended = np.unpackbits(surface[used], axis=1, bitorder="little").astype(np.bool_)
        arrays = _arrays(
            len(surface),
            max(_MIN_CAPACITY, 2 * len(used)),
            max(_MIN_ROWS, 2 * len(levels)),
        )
        arrays.places[used] = np.arange(1, 1 + len(used))
        arrays.seen_s[places] = seen_s[used]
        arrays.ended[places] = surface[used]
        arrays.rows[places][ended] = np.arange(1, 1 + len(levels))
        block, voxel = np.nonzero(ended)
        voxels = arrays.voxels[1 : 1 + len(levels)]
        voxels["owner"] = used[block] << (3 * SHIFT) | voxel
        # The least strength of each level, seen from one sector.
        known = levels > 0
        voxels["weight"] = known * LEAST_STRENGTH * 2.0 ** (levels - 1.0)
        voxels["sectors"] = known
        eighths = np.where(margins > 0, 2 * margins + 1, 0)
        voxels["lowest"], voxels["highest"] = eighths[:, :3], EIGHTHS - 1 - eighths[:, 3:]
        for name, counts in zip(_RECORD, outcome_counts(outcomes).T, strict=True):
            voxels[name] = counts
        voxels["company"] = True  # it was believed
        # The margins that a file has count, however few scans its hits stand for.
        is_sure = margins.any(axis=1)
        voxels["scans"] = np.where(is_sure, MOST_SCANS, np.minimum(voxels["hits"], MOST_SCANS))
        observations = cls(len(surface))
        observations._places, observations._rows = 1 + len(used), 1 + len(levels)
        observations.arrays = arrays
        return observations

    def _grow(self) -> None:
        """Double what is full."""
        places, rows, ended, seen_s, voxels = self.arrays
        if self._places == len(seen_s):
            of_places = (rows, ended, seen_s)
            rows, ended, seen_s = (with_room(array, 2 * len(seen_s)) for array in of_places)
        if self._rows == len(voxels):
            voxels = with_room(voxels, 2 * len(voxels))
        self.arrays = Observed(places, rows, ended, seen_s, voxels)


def _arrays(blocks: int, places: int, rows: int) -> Observed:
    voxels = np.zeros(rows, OBSERVED_VOXEL)
    voxels["highest"][0] = EIGHTHS - 1  # of a voxel of which nothing is known, no part is left out
    return Observed(
        places=np.zeros(blocks, np.int32),
        rows=np.zeros((places, _VOXELS), np.int32),
        ended=np.zeros((places, BLOCK_BYTES), np.uint8),
        seen_s=np.zeros(places, np.int64),
        voxels=voxels,
    )
