"""The evidence of rays in a region, while they go on to show more."""

from typing import Literal

import numpy as np
from triquad_format.records.arrays import Doubles, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES, surface_counts
from triquad_format.records.region import Evidence as EvidenceRecord

from triquad_map.compiled.team import Split, in_one
from triquad_map.compiled.voxel_index import VoxelIndex, with_room
from triquad_map.evidence.belief import Belief, Changes, believe
from triquad_map.evidence.carving import Reach, mark_crossed
from triquad_map.evidence.ended_rays import extend_new, set_discs
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.evidence.growth import EvidenceSize
from triquad_map.evidence.neighbours import ask_neighbours
from triquad_map.evidence.observations import Observations
from triquad_map.evidence.observed import Observed, Sighting
from triquad_map.evidence.ray_surfels import NormalSearch, put_ray_surfels
from triquad_map.evidence.seen_voxels import SeenVoxels, mark
from triquad_map.surface import Surfels

_MIN_CAPACITY = 256


class LiveEvidence:
    """Two bit masks over the voxels of a region, in sparse blocks of 8 x 8 x 8.

    One thread owns and changes it; :meth:`freeze` gives what others may read.
    """

    seen: SeenVoxels
    """What rays have shown of each voxel; its arrays are replaced when there is more."""

    def __init__(self, side: int) -> None:
        """Begin without evidence; ``side`` is that of the region, voxels."""
        self._blocks = VoxelIndex(_MIN_CAPACITY)
        masks = np.zeros((2, _MIN_CAPACITY, BLOCK_BYTES), np.uint8)
        self.seen = SeenVoxels(side, self._blocks.arrays, *masks)
        self._observations = Observations(_MIN_CAPACITY)
        self._frozen: FrozenEvidence | None = None  # until anything changes
        self._surface: int | None = 0  # voxels with surface; None: to be counted

    @property
    def surface_voxels(self) -> int:
        """The number of voxels with surface."""
        if self._surface is None:
            self._surface = int(surface_counts(self.seen.surface[: self._blocks.count]).sum())
        return self._surface

    @property
    def observed(self) -> Observed:
        """What was observed in each voxel, by the rows that :meth:`record_ends` gives."""
        return self._observations.arrays

    @property
    def size(self) -> EvidenceSize:
        """The size of the evidence."""
        observed = self._observations
        return EvidenceSize(self._blocks.count, observed.blocks, observed.voxels)

    def record_ends(self, voxels: Doubles, sighting: Sighting, split: Split = in_one) -> Ints:
        """Record that rays ended at ``voxels`` [N, 3], and from where and when.

        Args:
            voxels: the ends of all rays of a scan.
            sighting: the scan.
            split: shares the work.

        Returns:
            The row of what is recorded of each ray's voxel; 0 outside the region.
        """
        rows = self.add_ends(voxels, sighting)
        observed = self.observed
        alone = np.flatnonzero(~observed.voxels["company"][rows] & (rows > 0))
        told = ask_neighbours(voxels - sighting.origin, alone, split)
        observed.voxels["company"][rows[alone[told.have_company]]] = True
        extend_new(rows[alone], told.extents, sighting.scan, observed)
        return rows

    def add_ends(self, voxels: Doubles, sighting: Sighting) -> Ints:
        """Do as :meth:`record_ends` with rays of many scans: no ray's neighbours are asked."""
        self._frozen = None
        rows = np.empty(len(voxels), np.int32)
        done = 0
        while done < len(voxels):
            done, self._blocks.count = self._observations.record(
                voxels, done, self.seen, self._blocks.count, sighting, rows
            )
            if self._blocks.count == self._blocks.capacity:
                self._make_room(more=True)
        return rows

    def outdated_normals(self, rows: Ints, since: int) -> NormalSearch:
        """Return the search for normals of the surfaces on which the newest scan ended, by rows."""
        seen = self.seen._replace(blocks=self._blocks.freeze())
        return NormalSearch(rows, since, seen, self.observed)

    def believe(self, hit: Ints, passed: Ints, belief: Belief) -> Changes:
        """Let surface come and go where rays of a scan ended and passed, by rows."""
        self._frozen = None
        before, observed = self.surface_voxels, self.observed
        changes = Changes(*believe(hit, passed, self.seen, observed, belief))
        self._surface = before + len(changes.new) - len(changes.removed)
        return changes

    def set_discs(self, voxels: Longs, surfels: Surfels) -> None:
        """Take from ``surfels`` [N] where the surface lies in ``voxels`` [N, 3].

        For evidence that was restored: a record has voxels only. Where there is no disc, it is the
        nearest one next to it, or else the next ray that ends there shows where the surface is.
        """
        discs = surfels.offsets, surfels.normals, surfels.kinds
        set_discs(voxels, *discs, self.seen, self.observed)

    def ray_surfels(self, voxels: Longs, hit_since: int = 0, *, since: int) -> Surfels:
        """Return what rays alone show of surface that was first seen in scan ``since`` or later.

        Of voxels that were not hit since scan ``hit_since``, nothing is told. See
        :data:`triquad_map.surface.ShownByRays`.
        """
        surfels = Surfels.none(len(voxels))
        shown = surfels.offsets, surfels.normals, surfels.kinds
        put_ray_surfels(voxels, since, hit_since, self.seen, self.observed, *shown)
        return surfels

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
        passed = np.zeros(len(self.observed.voxels), np.int32)
        done = 0
        while done < len(ends):
            done, self._blocks.count = mark_crossed(
                origin,
                ends,
                done,
                reach,
                self.seen,
                self._blocks.count,
                self.observed,
                passed,
            )
            if done < len(ends):
                self._make_room(more=True)
        return passed[1 : 1 + passed[0]]

    def mark(self, what: Literal["surface", "free"], voxels: Doubles) -> None:
        """Record that there is surface in ``voxels`` [N, 3], or that they are free.

        Those outside the region are left out.
        """
        self._frozen = None
        if what == "surface":
            self._surface = None
        done = 0
        while done < len(voxels):
            mask = getattr(self.seen, what)
            done, self._blocks.count = mark(voxels, done, self.seen, mask, self._blocks.count)
            if done < len(voxels):
                self._make_room(more=True)

    def clear(self, low: Doubles, high: Doubles) -> None:
        """Forget the voxels whose centres lie between the corners ``low`` and ``high`` [3]."""
        self._frozen = self._surface = None
        corners = self._blocks.cells() * BLOCK_VOXELS
        near = ((corners < high) & (corners + BLOCK_VOXELS > low)).all(axis=1)
        offsets = np.stack(np.meshgrid(*[np.arange(BLOCK_VOXELS)] * 3, indexing="ij"), -1)
        for row in np.flatnonzero(near):
            centres = corners[row] + offsets + 0.5
            kept = ~((centres > low) & (centres < high)).all(axis=-1)
            keep = np.packbits(kept, axis=-1, bitorder="little").reshape(BLOCK_BYTES)
            self.seen.surface[row] &= keep
            self.seen.free[row] &= keep
        self._observations.forget(np.flatnonzero(near), self.seen.surface[: self._blocks.count])

    def freeze(self, split: Split = in_one) -> FrozenEvidence:
        """Return the evidence as it is now; the same object until anything changes."""
        if self._frozen is None:
            side, _, *masks = self.seen
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
        evidence.seen, evidence._surface = frozen.seen, None
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
        side, _, *masks = self.seen
        roomy = (with_room(mask, self._blocks.capacity) for mask in masks)
        self.seen = SeenVoxels(side, self._blocks.arrays, *roomy)
        self._observations.make_room(self._blocks.capacity)
