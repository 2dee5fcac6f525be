"""The evidence of rays in a region, while they go on to show more."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES
from triquad_format.records.region import Evidence as EvidenceRecord

from triquad_map.compiled.team import Split, in_one
from triquad_map.compiled.voxel_index import VoxelIndex, with_room
from triquad_map.evidence.carving import Reach, mark_crossed
from triquad_map.evidence.contradictions import Belief, take_back
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.evidence.growth import EvidenceSize, NewEnds, new_blocks, new_ends
from triquad_map.evidence.observations import Observations
from triquad_map.evidence.observed import Sighting
from triquad_map.evidence.ray_surfels import ray_surfels
from triquad_map.evidence.seen_voxels import SeenVoxels, mark_ends
from triquad_map.surface import Surfels

_MIN_CAPACITY = 256



class Marks(NamedTuple):
    """The voxels in which the rays of a scan ended."""

    new: Longs  # [M, 3] voxels in which there was no surface before
    rows: Ints  # [N] of each ray's voxel, for what is recorded of them later


class LiveEvidence:
    """Two bit masks over the voxels of a region, in sparse blocks of 8 x 8 x 8.

    One thread owns and changes it; :meth:`freeze` gives what others may read.
    """

    def __init__(self, side: int) -> None:
        """Begin without evidence; ``side`` is that of the region, voxels."""
        self._blocks = VoxelIndex(_MIN_CAPACITY)
        masks = np.zeros((2, _MIN_CAPACITY, BLOCK_BYTES), np.uint8)
        self._seen = SeenVoxels(side, self._blocks.arrays, *masks)
        self._observations = Observations(_MIN_CAPACITY)
        self._frozen: FrozenEvidence | None = None  # until anything changes

    @property
    def size(self) -> EvidenceSize:
        """The size of the evidence."""
        observed = self._observations
        return EvidenceSize(self._blocks.count, observed.blocks, observed.voxels)

    def surface_blocks(self) -> Longs:
        """Return the blocks [B, 3] in which surface is believed."""
        return self._blocks.cells()[self._seen.surface[: self._blocks.count].any(axis=1)]

    def new_ends(self, ends: Doubles) -> NewEnds:
        """Return what rays that end at ``ends`` [N, 3] would add; nothing is recorded."""
        return new_ends(ends, self._seen)

    def new_blocks(self, origin: Doubles, ends: Doubles) -> int:
        """Return about how many blocks rays from ``origin`` [3] to ``ends`` [N, 3] would add."""
        return new_blocks(origin, ends, self._seen)

    def mark_surface(self, voxels: Doubles, sighting: Sighting | None = None) -> Marks:
        """Record that rays ended at ``voxels`` [N, 3]; those outside the region are left out.

        ``sighting`` says from where and when; without it they support the surface no better.
        """
        self._frozen = None
        new = np.empty((len(voxels), 3), np.int64)
        done = found = 0
        while done < len(voxels):
            done, self._blocks.count, found = mark_ends(
                voxels, done, self._seen, self._blocks.count, new, found
            )
            if done < len(voxels):
                self._make_room(more=True)
        if sighting is None:
            return Marks(new[:found], np.zeros(len(voxels), np.int32))
        return Marks(new[:found], self._observations.record(voxels, self._seen, sighting))

    def set_normals(self, marks: Marks, normals: Doubles) -> None:
        """Keep the unit ``normals`` [N, 3] of surfaces that were marked; NaN where unknown."""
        self._observations.set_normals(marks.rows, normals)

    def first_seen_since(self, scan: int, marks: Marks) -> Bools:
        """Return which rays [N] ended on a surface that was first seen in ``scan`` or later.

        Rays that ended outside the region did not.
        """
        is_new: Bools = self._observations.arrays.voxels["first_scan"][marks.rows] >= scan
        return is_new & (marks.rows > 0)

    def set_discs(self, voxels: Longs, surfels: Surfels) -> None:
        """Take from ``surfels`` [N] where the surface lies in ``voxels`` [N, 3].

        For evidence that was restored: a record has voxels only.
        """
        self._observations.set_discs(voxels, surfels, self._seen)

    def ray_surfels(self, voxels: Longs, since: int) -> Surfels:
        """Return what rays alone show of surface that was first seen in scan ``since`` or later.

        See :data:`triquad_map.surface.ShownByRays`.
        """
        return ray_surfels(voxels, since, self._seen, self._observations.arrays)

    def carve(self, origin: Doubles, ends: Doubles, reach: Reach) -> Ints:
        """Record the free space between ``origin`` [3] and ``ends`` [N, 3].

        Args:
            origin: sensor position, may lie outside the region.
            ends: end points of the rays.
            reach: how far the rays show what they cross.

        Returns:
            Where rays passed a surface.
        """
        self._frozen = None
        passed = np.zeros(len(self._observations.arrays.voxels), np.int32)
        done = 0
        while done < len(ends):
            done, self._blocks.count = mark_crossed(
                origin,
                ends,
                done,
                reach,
                self._seen,
                self._blocks.count,
                self._observations.arrays,
                passed,
            )
            if done < len(ends):
                self._make_room(more=True)
        return passed[1 : 1 + passed[0]]

    def remove_contradicted(self, passed: Ints, belief: Belief) -> Longs:
        """Remove the surface of voxels that the rays of :meth:`carve` contradict.

        Args:
            passed: where these rays passed a surface.
            belief: when a surface is removed.

        Returns:
            These voxels [M, 3]; they are free.
        """
        self._frozen = None
        return take_back(passed, self._seen, self._observations.arrays, belief)

    def mark_free(self, voxels: Doubles) -> None:
        """Record that ``voxels`` [N, 3] are free; those outside the region are left out."""
        self._frozen = None
        new = np.empty((len(voxels), 3), np.int64)
        done = 0
        while done < len(voxels):
            free = self._seen._replace(surface=self._seen.free)
            done, self._blocks.count, _ = mark_ends(voxels, done, free, self._blocks.count, new, 0)
            if done < len(voxels):
                self._make_room(more=True)

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
            self._seen.surface[row] &= keep
            self._seen.free[row] &= keep
        self._observations.forget(np.flatnonzero(near), self._seen.surface[: self._blocks.count])

    def freeze(self, split: Split = in_one) -> FrozenEvidence:
        """Return the evidence as it is now; the same object until anything changes."""
        if self._frozen is None:
            side, _, *masks = self._seen
            surface, free = (mask[: self._blocks.count].copy() for mask in masks)
            self._frozen = FrozenEvidence(
                SeenVoxels(side, self._blocks.freeze(), surface, free),
                *self._observations.support(surface, split),
                self._observations.seen_s(self._blocks.count),
            )
        return self._frozen

    def record(self) -> EvidenceRecord:
        """Return the evidence as the map file has it, with what is needed to go on from it."""
        frozen = self.freeze()
        return frozen.record(self._observations.outcomes(frozen.surface))

    @classmethod
    def from_record(cls, side: int, record: EvidenceRecord) -> "LiveEvidence":
        """Return the evidence of a record, of a region of ``side`` voxels."""
        evidence, frozen = cls(side), FrozenEvidence.from_record(side, record)
        evidence._blocks = VoxelIndex.of_cells(frozen.cells)
        evidence._seen = frozen.seen
        evidence._observations = Observations.restore(
            frozen.surface,
            frozen.levels,
            frozen.seen_s,
            margins=frozen.margins,
            outcomes=record.outcomes,
        )
        evidence._make_room()
        return evidence

    def _make_room(self, more: bool = False) -> None:
        """Make room for as many blocks as the index has room for, or for ``more``."""
        if more:
            self._blocks.grow()
        side, _, *masks = self._seen
        roomy = (with_room(mask, self._blocks.capacity) for mask in masks)
        self._seen = SeenVoxels(side, self._blocks.arrays, *roomy)
        self._observations.make_room(self._blocks.capacity)
