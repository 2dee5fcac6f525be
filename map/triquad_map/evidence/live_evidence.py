"""The evidence of rays in a region, while they go on to show more."""

from typing import Literal

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES, surface_counts, used_blocks
from triquad_format.records.region import Evidence as EvidenceRecord

from triquad_map.compiled.team import Split, in_one
from triquad_map.compiled.voxel_index import SHIFT, VoxelIndex, with_room
from triquad_map.evidence.belief import Changes, believe
from triquad_map.evidence.carving import Reach, mark_crossed
from triquad_map.evidence.ended_rays import extend_new, record_ends, set_discs
from triquad_map.evidence.evidence import FrozenEvidence, outcome_codes, outcome_counts
from triquad_map.evidence.growth import EvidenceSize
from triquad_map.evidence.neighbours import ask_neighbours
from triquad_map.evidence.observed import (
    EIGHTHS,
    MOST_SCANS,
    OBSERVED_VOXEL,
    Observed,
    Sighting,
)
from triquad_map.evidence.ray_surfels import NormalSearch, put_ray_surfels
from triquad_map.evidence.seen_voxels import SeenVoxels, mark
from triquad_map.evidence.support import surface_support
from triquad_map.surface import LEAST_STRENGTH, Surfels

_MIN_CAPACITY = 256
_MIN_PLACES = 64
_MIN_ROWS = 1024
_RECORD = ("hits", "earlier_misses", "earlier_misses")
"""The fields of a voxel's record that files keep; passes are none but those that would have hit."""


class LiveEvidence:
    """Two bit masks over the voxels of a region, in sparse blocks of 8 x 8 x 8.

    One thread owns and changes it; :meth:`freeze` gives what others may read.
    """

    seen: SeenVoxels
    """What rays have shown of each voxel; its arrays are replaced when there is more."""

    observed: Observed
    """What was observed in each voxel in which rays ended, by the rows that :meth:`record_ends`
    gives; likewise."""

    def __init__(self, side: int) -> None:
        """Begin without evidence; ``side`` is that of the region, voxels."""
        self._blocks = VoxelIndex(_MIN_CAPACITY)
        masks = np.zeros((2, _MIN_CAPACITY, BLOCK_BYTES), np.uint8)
        self.seen = SeenVoxels(side, self._blocks.arrays, *masks)
        self.observed = _nothing_observed(_MIN_CAPACITY, _MIN_PLACES, _MIN_ROWS)
        self._places = self._rows = 1  # in use, of what was observed
        self._frozen: FrozenEvidence | None = None  # until anything changes
        self._surface: int | None = 0  # voxels with surface; None: to be counted

    @property
    def surface_voxels(self) -> int:
        """The number of voxels with surface."""
        if self._surface is None:
            self._surface = int(surface_counts(self.seen.surface[: self._blocks.count]).sum())
        return self._surface

    @property
    def size(self) -> EvidenceSize:
        """The size of the evidence."""
        return EvidenceSize(self._blocks.count, self._places - 1, self._rows - 1)

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
        found = np.empty(len(voxels), np.int32)
        done = 0
        while done < len(voxels):
            done, self._blocks.count, self._places, self._rows = record_ends(
                voxels,
                done,
                self.seen,
                self._blocks.count,
                sighting,
                self.observed,
                self._places,
                self._rows,
                found,
            )
            self._make_room()
        return found

    def outdated_normals(self, rows: Ints, since: int) -> NormalSearch:
        """Return the search for normals of the surfaces on which the newest scan ended, by rows."""
        seen = self.seen._replace(blocks=self._blocks.freeze())
        return NormalSearch(rows, since, seen, self.observed)

    def believe(self, hit: Ints, passed: Ints) -> Changes:
        """Let surface come and go where rays of a scan ended and passed, by rows."""
        self._frozen = None
        before, observed = self.surface_voxels, self.observed
        changes = Changes(*believe(hit, passed, self.seen, observed))
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
        near = np.flatnonzero(((corners < high) & (corners + BLOCK_VOXELS > low)).all(axis=1))
        offsets = np.stack(np.meshgrid(*[np.arange(BLOCK_VOXELS)] * 3, indexing="ij"), -1)
        for row in near:
            centres = corners[row] + offsets + 0.5
            kept = ~((centres > low) & (centres < high)).all(axis=-1)
            keep = np.packbits(kept, axis=-1, bitorder="little").reshape(BLOCK_BYTES)
            self.seen.surface[row] &= keep
            self.seen.free[row] &= keep
        surface, places = self.seen.surface[near], self.observed.places[near]
        self.observed.rows[places] *= np.unpackbits(surface, axis=1, bitorder="little")
        self.observed.ended[places] &= surface

    def freeze(self, split: Split = in_one) -> FrozenEvidence:
        """Return the evidence as it is now; the same object until anything changes."""
        if self._frozen is None:
            side, _, *masks = self.seen
            surface, free = (mask[: self._blocks.count].copy() for mask in masks)
            self._frozen = FrozenEvidence(
                SeenVoxels(side, self._blocks.freeze(), surface, free),
                *surface_support(surface, self.observed, split),
                self.observed.seen_s[self.observed.places[: self._blocks.count]],
            )
        return self._frozen

    def record(self) -> EvidenceRecord:
        """Return the evidence as the map file has it, with what is needed to go on from it."""
        frozen, observed = self.freeze(), self.observed
        used = used_blocks(frozen.surface)
        ended = np.unpackbits(frozen.surface[used], axis=1, bitorder="little").astype(np.bool_)
        records = observed.voxels[observed.rows[observed.places[used]][ended]]
        return frozen.record(outcome_codes(np.stack([records[name] for name in _RECORD], axis=1)))

    @classmethod
    def from_record(cls, side: int, record: EvidenceRecord) -> "LiveEvidence":
        """Return the evidence of a record, of a region of ``side`` voxels."""
        evidence, frozen = cls(side), FrozenEvidence.from_record(side, record)
        evidence._blocks = VoxelIndex.of_cells(frozen.cells)
        evidence.seen, evidence._surface = frozen.seen, None
        evidence.observed = _restored(frozen, record.outcomes)
        evidence._places = 1 + len(used_blocks(frozen.surface))
        evidence._rows = 1 + len(frozen.levels)
        evidence._fit_to_blocks()
        return evidence

    def _make_room(self, more: bool = False) -> None:
        """Double what is full; the blocks, too, where there must be ``more``."""
        if more or self._blocks.count == self._blocks.capacity:
            self._blocks.grow()
            self._fit_to_blocks()
        places, rows, ended, seen_s, voxels = self.observed
        if self._places == len(seen_s):
            of_places = (rows, ended, seen_s)
            rows, ended, seen_s = (with_room(array, 2 * len(seen_s)) for array in of_places)
        if self._rows == len(voxels):
            voxels = with_room(voxels, 2 * len(voxels))
        self.observed = Observed(places, rows, ended, seen_s, voxels)

    def _fit_to_blocks(self) -> None:
        """Make room for as many blocks as the index has room for."""
        side, _, *masks = self.seen
        roomy = (with_room(mask, self._blocks.capacity) for mask in masks)
        self.seen = SeenVoxels(side, self._blocks.arrays, *roomy)
        places = with_room(self.observed.places, self._blocks.capacity)
        self.observed = self.observed._replace(places=places)


def _restored(frozen: FrozenEvidence, outcomes: Bytes) -> Observed:
    """Return observations that give levels, margins and ``outcomes`` [S, 3] as they were."""
    surface, levels, margins = frozen.surface, frozen.levels, frozen.margins
    used = used_blocks(surface)
    places = slice(1, 1 + len(used))
    ended = np.unpackbits(surface[used], axis=1, bitorder="little").astype(np.bool_)
    observed = _nothing_observed(
        len(surface), max(_MIN_PLACES, 2 * len(used)), max(_MIN_ROWS, 2 * len(levels))
    )
    observed.places[used] = np.arange(1, 1 + len(used))
    observed.seen_s[places] = frozen.seen_s[used]
    observed.ended[places] = surface[used]
    observed.rows[places][ended] = np.arange(1, 1 + len(levels))
    block, voxel = np.nonzero(ended)
    voxels = observed.voxels[1 : 1 + len(levels)]
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
    return observed


def _nothing_observed(blocks: int, places: int, rows: int) -> Observed:
    """Return room for what will be observed."""
    voxels = np.zeros(rows, OBSERVED_VOXEL)
    voxels["highest"][0] = EIGHTHS - 1  # of a voxel of which nothing is known, no part is left out
    return Observed(
        places=np.zeros(blocks, np.int32),
        rows=np.zeros((places, BLOCK_VOXELS**3), np.int32),
        ended=np.zeros((places, BLOCK_BYTES), np.uint8),
        seen_s=np.zeros(places, np.int64),
        voxels=voxels,
    )
