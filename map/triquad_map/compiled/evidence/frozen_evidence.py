"""The evidence of a region that does not change."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.region import Evidence as EvidenceRecord
from triquad_format.records.region import surface_counts

from triquad_map.compiled.evidence.seen_voxels import SeenVoxels, find_ends, find_status
from triquad_map.compiled.evidence.unknown_search import find_unknown
from triquad_map.compiled.sparse.voxel_index import VoxelIndex, cells_of

_SEEN_STEP_S = 60


@dataclass(frozen=True)
class FrozenEvidence:
    """What rays have shown of a region; in voxel coordinates, for any thread."""

    seen: SeenVoxels
    levels: Bytes  # [S] how well each voxel in ``surface`` is supported, in their order
    seen_s: Longs  # [B] when a ray last ended in each block, seconds since 1970; 0: never

    @property
    def surface(self) -> Bytes:
        """The voxels in which rays ended [B, BLOCK_BYTES]."""
        return self.seen.surface

    @property
    def cells(self) -> Longs:
        """The blocks [B, 3], in units of blocks."""
        return np.asarray(cells_of(self.seen.blocks.row_keys))

    @property
    def newest_s(self) -> int:
        """When a ray last ended anywhere, seconds since 1970; 0: never, or not known."""
        return int(self.seen_s.max(initial=0))

    def status(self, voxels: Doubles, reach: float = 0.5) -> Bytes:
        """:class:`~triquad_format.records.status.Status` values [N] at ``voxels`` [N, 3].

        ``SURFACE`` reaches ``reach`` voxels beyond those in which rays ended.
        """
        status = np.empty(len(voxels), np.uint8)
        find_status(voxels, reach, self.seen, status)
        return status

    def ended_in(self, voxels: Longs) -> Bools:
        """Whether rays ended in ``voxels`` [N, 3]."""
        ended = np.empty(len(voxels), np.bool_)
        find_ends(voxels, self.seen, ended)
        return ended

    def find_unknown(
        self, voxels: Doubles, blocks: range, distances: Doubles, nearest: Doubles
    ) -> None:
        """Find unknown voxels near ``voxels`` [N, 3]; see :func:`unknown_search.find_unknown`."""
        find_unknown(voxels, self.seen, (blocks.start, blocks.stop), distances, nearest)

    def surface_cells(self) -> Longs:
        """Blocks [B, 3], in units of blocks, that hold any seen surface."""
        return self.cells[self.surface.any(axis=1)]

    def record(self) -> EvidenceRecord:
        """The evidence as the map file holds it; empty blocks are left out."""
        surface, free = self.seen.surface, self.seen.free
        used = np.flatnonzero((surface | free).any(axis=1))
        codes = morton.encode(self.cells[used])
        order = np.argsort(codes)
        used = used[order]
        counts = surface_counts(surface)
        firsts = np.cumsum(counts) - counts
        # The levels block by block, in the order of the record.
        runs = np.repeat(firsts[used] - (np.cumsum(counts[used]) - counts[used]), counts[used])
        levels = self.levels[runs + np.arange(len(runs))]
        # In whole minutes: else each scan would change every part that it sees.
        seen_s = np.where(counts > 0, self.seen_s // _SEEN_STEP_S * _SEEN_STEP_S, 0)
        return EvidenceRecord(codes[order], surface[used], free[used], levels, seen_s[used])

    @classmethod
    def from_record(cls, side: int, record: EvidenceRecord) -> "FrozenEvidence":
        """The evidence of a record, of a region of ``side`` voxels."""
        index = VoxelIndex.of_cells(morton.decode(record.codes, 3)).freeze()
        levels, seen_s = record.levels, record.seen_s
        if levels is None:
            levels = np.zeros(int(surface_counts(record.surface).sum()), np.uint8)
        if seen_s is None:
            seen_s = np.zeros(len(record.codes), np.int64)
        masks = (np.ascontiguousarray(mask) for mask in (record.surface, record.free))
        return cls(SeenVoxels(side, index, *masks), levels, seen_s)
