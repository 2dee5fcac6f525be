"""The evidence of rays in a region: sparse voxels in which a surface or free space was seen.

Three planes alias: where all three projections of an unobserved point are occupied, the field
answers as if it had been seen. Only a 3-D record can distinguish such ghosts from surfaces.

All coordinates here are voxel coordinates of the region (see :mod:`triquad_format.records.region`).

Files have the outcomes of rays at a voxel on a scale of powers of two, which distinguishes a fence,
hit and missed by turns, from a wall. A wall has the codes 0: it was hit often, and hardly a ray
passed. So has a voxel of which nothing is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Doubles, Ints, Longs
from triquad_format.records.region import OUTCOME_BITS, surface_counts
from triquad_format.records.region import Evidence as EvidenceRecord
from triquad_format.records.status import Status

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import (
    SHIFT,
    VoxelIndex,
    cells_of,
    find_block,
    is_set,
)
from triquad_map.evidence.seen_voxels import SeenVoxels, find_unknown, surface_in_grid
from triquad_map.evidence.support import (
    margins_that_count,
    near_ends,
)

_SEEN_STEP_S = 60

_MOST_HITS = 8
"""A longer record is restored as one of this many hits, which new rays outweigh sooner."""

_LEAST_SHARE_LOG2 = -3  # of passes or misses, for each hit: of one in eight; fewer are none
_SHARES = (1 << OUTCOME_BITS[1]) - 1

_SURFACE = np.uint8(Status.SURFACE)
_FREE = np.uint8(Status.FREE)
_UNKNOWN = np.uint8(Status.UNKNOWN)


@kernel()
def _status(voxels: Doubles, reach: float, seen: SeenVoxels) -> Bytes:
    """Return status [N] at ``voxels`` [N, 3]; surfaces reach ``reach`` beyond theirs."""
    status = np.empty(len(voxels), np.uint8)
    side, blocks, surface, free = seen
    for i in range(len(voxels)):
        x0, x1 = int(np.floor(voxels[i, 0] - reach)), int(np.floor(voxels[i, 0] + reach))
        y0, y1 = int(np.floor(voxels[i, 1] - reach)), int(np.floor(voxels[i, 1] + reach))
        z0, z1 = int(np.floor(voxels[i, 2] - reach)), int(np.floor(voxels[i, 2] + reach))
        found = 0
        row = find_block(blocks, x0, y0, z0, side)
        block = (x0 >> SHIFT, y0 >> SHIFT, z0 >> SHIFT)
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                for z in range(z0, z1 + 1):
                    here = (x >> SHIFT, y >> SHIFT, z >> SHIFT)
                    if here != block:
                        row = find_block(blocks, x, y, z, side)
                        block = here
                    if row >= 0:
                        found |= is_set(surface, row, x, y, z)
            if found:
                break
        status[i] = _UNKNOWN
        if found:
            status[i] = _SURFACE
            continue
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        row = find_block(blocks, x, y, z, side)
        if row >= 0 and is_set(free, row, x, y, z):
            status[i] = _FREE
    return status


@dataclass(frozen=True)
class FrozenEvidence:
    """Evidence that does not change, for any thread."""

    seen: SeenVoxels
    levels: Bytes  # [S] how well each voxel in ``surface`` is supported, in their order
    scans: Bytes | None  # [S] of which rays ended in each; None: what is beyond them counts
    beyond: Bytes  # [S, 6] quarters of each on each side, at the end of which none did
    seen_s: Longs  # [B] when a ray last ended in each block, seconds since 1970; 0: never

    @property
    def surface(self) -> Bytes:
        """The voxels in which rays ended [B, BLOCK_BYTES]."""
        return self.seen.surface

    @cached_property
    def _firsts(self) -> Longs:
        """[B] The number of each block's first voxel among those with surface."""
        counts = surface_counts(self.surface)
        return np.cumsum(counts) - counts

    @cached_property
    def margins(self) -> Bytes:
        """[S, 6] Quarters of each voxel on each side where the surface ends; 0: it goes on."""
        if self.scans is None:
            return self.beyond
        return margins_that_count(self.seen, self._firsts, self.scans, self.beyond)

    @property
    def cells(self) -> Longs:
        """The blocks [B, 3], in units of blocks."""
        return cells_of(self.seen.blocks.row_keys)

    @property
    def newest_s(self) -> int:
        """The time when a ray last ended anywhere, seconds since 1970; 0: never, or not known."""
        return int(self.seen_s.max(initial=0))

    def status(self, voxels: Doubles, reach: float = 0.5) -> Bytes:
        """Return values of :class:`Status` [N] at leaf coordinates [N, 3].

        ``SURFACE`` reaches ``reach`` voxels beyond those in which rays ended.
        """
        return _status(voxels, reach, self.seen)

    def surface_in_grid(self, axes: Sequence[Doubles], reach: float) -> Bools:
        """Return which points [X, Y, Z] of a grid have the status ``SURFACE``, by :meth:`status`.

        ``axes`` are their leaf coordinates [X], [Y] and [Z], increasing.
        """
        return surface_in_grid(axes, reach, self.seen)

    def near_ends(self, voxels: Doubles, reach: float) -> Bools:
        """Return whether leaf coordinates [N, 3] lie where rays ended.

        That is within ``reach`` voxels of one in which they did, on each axis, and not in its
        margins (:attr:`triquad_format.records.region.Evidence.margins`).
        """
        return near_ends(voxels, reach, self.seen, self._firsts, self.margins)

    def ended_in(self, voxels: Longs) -> Bools:
        """Return whether rays ended in ``voxels`` [N, 3]."""
        ended: Bools = self.status((voxels + 0.5).astype(np.float64), reach=0.0) == _SURFACE
        return ended

    def find_unknown(
        self, voxels: Doubles, blocks: range, distances: Doubles, nearest: Doubles
    ) -> None:
        """Lower ``distances`` [N] to those from ``voxels`` [N, 3] to the nearest unknown voxel.

        Points are leaf coordinates, as are the ``nearest`` [N, 3] of unknown space; distances are
        in voxels. Only blocks whose indices are in ``blocks`` on each axis are searched.
        """
        find_unknown(voxels, self.seen, (blocks.start, blocks.stop), distances, nearest)

    def surface_cells(self) -> Longs:
        """Return blocks [B, 3], in units of blocks, that contain any seen surface."""
        return self.cells[self.surface.any(axis=1)]

    def part(self, rows: Longs) -> "FrozenEvidence":
        """Return the evidence of some blocks alone, by their rows [P], increasing."""
        seen = self.seen
        index = VoxelIndex.of_cells(self.cells[rows]).freeze()
        counts = surface_counts(self.surface)
        chosen = np.isin(np.repeat(np.arange(len(counts)), counts), rows)
        return FrozenEvidence(
            SeenVoxels(seen.side, index, seen.surface[rows], seen.free[rows]),
            self.levels[chosen],
            scans=None if self.scans is None else self.scans[chosen],
            beyond=self.beyond[chosen],
            seen_s=self.seen_s[rows],
        )

    def record(self, outcomes: Bytes | None = None) -> EvidenceRecord:
        """Return the evidence as the map file has it; empty blocks are left out.

        ``outcomes`` [S, 3] are those of the voxels in ``surface``, in their order; without them
        nothing is known of any.
        """
        if outcomes is None:
            outcomes = np.zeros((len(self.levels), len(OUTCOME_BITS)), np.uint8)
        surface, free = self.seen.surface, self.seen.free
        used = np.flatnonzero((surface | free).any(axis=1))
        codes = morton.encode(self.cells[used])
        order = np.argsort(codes)
        used = used[order]
        counts, firsts = surface_counts(surface), self._firsts
        # The voxels block by block, in the order of the record.
        runs = np.repeat(firsts[used] - (np.cumsum(counts[used]) - counts[used]), counts[used])
        voxels = runs + np.arange(len(runs))
        # In whole minutes: else each scan would change every part that it sees.
        seen_s = np.where(counts > 0, self.seen_s // _SEEN_STEP_S * _SEEN_STEP_S, 0)
        return EvidenceRecord(
            codes[order],
            surface[used],
            free[used],
            levels=self.levels[voxels],
            seen_s=seen_s[used],
            outcomes=outcomes[voxels],
            margins=self.margins[voxels],
        )

    @classmethod
    def from_record(cls, side: int, record: EvidenceRecord) -> "FrozenEvidence":
        """Return the evidence of a record, of a region of ``side`` voxels."""
        index = VoxelIndex.of_cells(morton.decode(record.codes, 3)).freeze()
        masks = (np.ascontiguousarray(mask) for mask in (record.surface, record.free))
        seen = SeenVoxels(side, index, *masks)
        return cls(seen, record.levels, scans=None, beyond=record.margins, seen_s=record.seen_s)


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
