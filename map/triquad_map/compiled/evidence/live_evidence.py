"""What the rays have shown of a region: sparse voxels in which a surface or free space was seen.

Three planes alias: where all three projections of an unobserved point are occupied, the field
answers as if it had been seen. Only a 3-D record can tell such ghosts from surfaces.

All coordinates here are voxel coordinates of the region (see :mod:`triquad_format.records.region`).
"""

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.region import BLOCK_BYTES, BLOCK_VOXELS
from triquad_format.records.region import Evidence as EvidenceRecord

from triquad_map.compiled.evidence.frozen_evidence import FrozenEvidence
from triquad_map.compiled.evidence.marking import mark_crossed, mark_ends
from triquad_map.compiled.evidence.observations import Observations, Sighting
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.sparse.rows import with_room
from triquad_map.compiled.sparse.voxel_index import VoxelIndex

_MIN_CAPACITY = 256


class LiveEvidence:
    """Two bit masks over the voxels of a region, in sparse blocks of 8 x 8 x 8.

    One thread owns and changes it; :meth:`freeze` gives what others may read.
    """

    def __init__(self, side: int) -> None:
        """``side`` is that of the region, voxels."""
        self._side = side
        self._blocks = VoxelIndex(_MIN_CAPACITY)
        self._surface = np.zeros((_MIN_CAPACITY, BLOCK_BYTES), np.uint8)
        self._free = np.zeros((_MIN_CAPACITY, BLOCK_BYTES), np.uint8)
        self._observations = Observations(_MIN_CAPACITY)
        self._frozen: FrozenEvidence | None = None  # until anything changes

    @property
    def blocks(self) -> int:
        """Blocks in use."""
        return self._blocks.count

    def mark_surface(self, voxels: Doubles, sighting: Sighting | None = None) -> Longs:
        """Record that rays ended at ``voxels`` [N, 3]; those outside the region are left out.

        ``sighting`` tells from where and when; without it they support the surface no better.

        Returns:
            The voxels [M, 3] in which no ray had ended before.
        """
        self._frozen = None
        new = np.empty((len(voxels), 3), np.int64)
        done = found = 0
        while done < len(voxels):
            done, self._blocks.count, found = mark_ends(
                voxels,
                done,
                self._side,
                self._blocks.arrays,
                self._surface,
                self._blocks.count,
                new,
                found,
            )
            if done < len(voxels):
                self._grow()
        if sighting is not None:
            self._observations.record(voxels, self._side, self._blocks.arrays, sighting)
        return new[:found]

    def carve(self, origin: Doubles, ends: Doubles, stop_short: float) -> None:
        """Record the free space between ``origin`` [3] and ``ends`` [N, 3].

        Args:
            origin: sensor position, may lie outside the region.
            ends: end points of the rays.
            stop_short: voxels before its end point where a ray stops to prove free space.
        """
        self._frozen = None
        done = 0
        while done < len(ends):
            done, self._blocks.count = mark_crossed(
                origin,
                ends,
                done,
                stop_short,
                self._side,
                self._blocks.arrays,
                self._free,
                self._blocks.count,
            )
            if done < len(ends):
                self._grow()

    def clear(self, low: Doubles, high: Doubles) -> None:
        """Forget the voxels whose centres lie between the corners ``low`` and ``high`` [3]."""
        self._frozen = None
        corners = self._blocks.cells() * BLOCK_VOXELS
        near = ((corners < high) & (corners + BLOCK_VOXELS > low)).all(axis=1)
        offsets = np.stack(np.meshgrid(*[np.arange(BLOCK_VOXELS)] * 3, indexing="ij"), -1)
        for row in np.flatnonzero(near):
            centres = corners[row] + offsets + 0.5
            kept = ~((centres > low) & (centres < high)).all(axis=-1)
            keep = np.packbits(kept, axis=-1, bitorder="little").reshape(BLOCK_BYTES)
            self._surface[row] &= keep
            self._free[row] &= keep
        self._observations.forget(np.flatnonzero(near), self._surface[: self.blocks])

    def freeze(self) -> FrozenEvidence:
        """The evidence as it is now; the same object until anything changes."""
        if self._frozen is None:
            surface, free = self._surface[: self.blocks].copy(), self._free[: self.blocks].copy()
            self._frozen = FrozenEvidence(
                SeenVoxels(self._side, self._blocks.freeze(), surface, free),
                self._observations.levels(surface),
                self._observations.seen_s(self.blocks),
            )
        return self._frozen

    @classmethod
    def from_record(cls, side: int, record: EvidenceRecord) -> "LiveEvidence":
        """The evidence of a record, of a region of ``side`` voxels."""
        evidence, frozen = cls(side), FrozenEvidence.from_record(side, record)
        evidence._blocks = VoxelIndex.of_cells(frozen.cells)
        evidence._surface = with_room(frozen.seen.surface, evidence._blocks.capacity)
        evidence._free = with_room(frozen.seen.free, evidence._blocks.capacity)
        if record.levels is not None:
            evidence._observations = Observations.restore(
                frozen.surface, frozen.levels, frozen.seen_s
            )
        return evidence

    def _grow(self) -> None:
        self._blocks.grow()
        self._surface = with_room(self._surface, self._blocks.capacity)
        self._free = with_room(self._free, self._blocks.capacity)
