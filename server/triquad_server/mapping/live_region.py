"""One region of the live map: its field, its evidence and its training."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple
from weakref import ref

import numpy as np
from triquad_format.mapfile.region_facts import RegionFacts
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import Region, TrainingState
from triquad_map.evidence.belief import have_surface
from triquad_map.evidence.growth import EvidenceSize, new_blocks, new_ends
from triquad_map.field.frozen_field import field_samples

from triquad_server.engine.compiled_trainer import Loss
from triquad_server.engine.field_record import field_from_record, region_record
from triquad_server.engine.live_field import initial_field
from triquad_server.epochs.buffers import buffers_of
from triquad_server.epochs.epoch import FrozenRegion
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.region_evidence import RegionEvidence, SeenScan
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.region_training import LEARNT_SCANS, RegionTraining
from triquad_server.mapping.replay.ray_table import RayTable, draw_ordered_samples
from triquad_server.mapping.replay.replay_record import recorded_rays


class RegionSize(NamedTuple):
    """The size of what a region holds, or would hold in addition."""

    evidence: EvidenceSize
    vertices: int  # of its quadtrees
    rays: int = 0  # that are kept of it


@dataclass(frozen=True)
class RegionSnapshot:
    """A copy of what a record needs of a region.

    Finding the rays that a file holds, and their order, takes ten times as long as copying them.
    """

    region: Region  # without a training state
    training: TrainingState  # without rays and samples
    table: RayTable  # all kept rays: those to train on, then those that are held out
    trained: int  # how many are to train on
    setup: RegionSetup

    def record(self) -> Region:
        """Return the region with all of its training state as plain arrays."""
        setup = self.setup
        rays, others = recorded_rays(self.table, setup.field)
        others = others[others < self.trained]  # samples are for training
        rng = np.random.default_rng(len(others))
        # In place of what is no ray that ends in the cube.
        samples = draw_ordered_samples(self.table, others, setup.placement, rng, setup.team)
        training = replace(
            self.training,
            rays=rays,
            sample_points=samples.points,
            sample_labels=samples.labels.astype(np.float16),
        )
        return replace(self.region, training=training)


class OwedCopy:
    """A copy of a region as it was at a moment: made when it is taken, or before a change.

    All is for the thread that owns the map. If nobody refers to it any more it is never made.
    """

    def __init__(self, copy: Callable[[], RegionSnapshot]) -> None:
        self._copy: Callable[[], RegionSnapshot] | None = copy
        self._made: RegionSnapshot | None = None

    @property
    def is_due(self) -> bool:
        """Whether it has to be made before the region changes."""
        return self._copy is not None

    @property
    def is_made(self) -> bool:
        """Whether it is made, and waits to be taken."""
        return self._made is not None

    def make(self) -> None:
        """Make the copy, unless it is made."""
        if self._copy is not None:
            self._made, self._copy = self._copy(), None

    def take(self) -> RegionSnapshot:
        """Return the copy, which can be taken once."""
        self.make()
        taken, self._made = self._made, None
        assert taken is not None, "it was taken before"
        return taken


class LiveRegion:
    """A region that is being mapped, by one thread. Everything public is in the map frame."""

    def __init__(
        self, index: RegionIndex, setup: RegionSetup, record: Region | None = None
    ) -> None:
        """Restore a region, or make one of which nothing is known yet.

        Of a record without training state there is nothing to train on.
        """
        seen, state = (None, None) if record is None else (record.evidence, record.training)
        field_seed, seed = setup.seeds(index)
        self.index = index
        self.centre = setup.field.region_centre(index)
        self.field = (
            initial_field(setup.field, setup.memory, field_seed)
            if record is None
            else field_from_record(record, setup.field, setup.memory, field_seed)
        )
        self.evidence = RegionEvidence(setup, self.centre, seed, seen)
        self.training = RegionTraining(self.field, setup, self.centre, seed, state)
        self._setup = setup
        self._published: FrozenRegion | None = None
        self.is_changed = True  # changed since it was published
        self._copies: list[ref[OwedCopy]] = []  # that somebody wants, or has taken by now

    @property
    def size(self) -> RegionSize:
        """Return the size of the region."""
        rays = self.training.rays
        kept = len(rays.pool) + len(rays.held_out)
        return RegionSize(self.evidence.live.size, self.field.vertices, kept)

    def facts(self, memory_bytes: int) -> RegionFacts:
        """Return what a checkpoint tells of the region, as it was published last."""
        published = self._published
        assert published is not None, "it is published before it is stored"
        return RegionFacts(
            vertices=published.vertices,
            parameters=published.parameters,
            rays=len(self.training.rays.pool),
            samples_left=self.training.budget.samples,
            newest_s=published.newest_s,
            memory_bytes=memory_bytes,
        )

    def is_as_of(self, epoch: int) -> bool:
        """Return whether it has not changed since an epoch."""
        published = self._published
        return published is not None and not self.is_changed and published.changed <= epoch

    def new_voxels(self, rays: ScanRays) -> int:
        """Return in how many voxels rays would end for the first time."""
        return len(new_ends(self.evidence.voxels(rays.ends), self.evidence.live.seen).voxels)

    def growth_by(self, rays: ScanRays) -> RegionSize:
        """Return what the rays would add to it; of the space that they cross, an estimate."""
        voxels, seen = self.evidence.voxels, self.evidence.live.seen
        new = new_ends(voxels(rays.ends), seen)
        ways = voxels(np.concatenate([rays.ends, rays.free_corners]))
        blocks = new_blocks(voxels(rays.origin[None])[0], ways, seen)
        size = EvidenceSize(blocks, new.blocks, len(new.voxels))
        kept = int(self._setup.training.rays_per_voxel * len(new.voxels))
        return RegionSize(size, self.field.growth_by(new.voxels), kept)

    def scan_seen(self, rays: ScanRays, stamp_s: int) -> SeenScan:
        """Record what the rays of a scan show."""
        self._begin_change()
        return self.evidence.scan_seen(rays, stamp_s)

    def believe(self, seen: SeenScan) -> None:
        """Let surface come and go by what a scan has shown, and grow the field where it is new."""
        # A leaf of the trees is the shadow of a voxel: where surface was before, nothing grows.
        new = self.evidence.believe(seen)
        self.field.grow(new)
        self.training.surface_appeared(new)

    def scan_taken(self, rays: ScanRays, seen: SeenScan) -> None:
        """Keep the rays of a scan for training, after :meth:`believe`."""
        is_new = self.evidence.first_seen_within(LEARNT_SCANS, seen.rows)
        # A return that is not believed, a drop of rain or the first of far things, teaches nothing.
        ends_elsewhere = seen.rows == 0
        live = self.evidence.live
        used = ends_elsewhere | have_surface(seen.rows, live.seen, live.observed)
        self.training.scan_taken(rays, seen.normals, used, is_new & used)

    def take_step(self) -> tuple[Loss, int]:
        """Take one optimiser step; return loss and samples. On a GPU, reading the loss waits."""
        self._begin_change()
        return self.training.take_step()

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Forget evidence and samples between two corners [3]."""
        self._begin_change()
        self.evidence.forget(low, high)
        self.training.forget(low, high)

    def publish(self, epoch: int) -> FrozenRegion:
        """Return the region as it is now, for ``epoch``; the last one again if nothing changed."""
        if self._published is not None and not self.is_changed:
            return self._published
        field = self.field.freeze()
        samples = field_samples(field, self._setup.field, self._setup.team.split)
        is_settled = self.training.is_settled
        evidence, surfels, removed = self.evidence.published(
            samples, self.field.version, epoch, is_settled=is_settled
        )
        self.training.published(field, surfels, removed)
        self._published = FrozenRegion(
            index=self.index,
            centre=self.centre,
            engine=field,
            evidence=evidence,
            surfels=surfels,
            changed=epoch,
            buffers=buffers_of((field, evidence, surfels)),
        )
        self.is_changed = False
        return self._published

    @property
    def is_owed(self) -> bool:
        """Whether somebody waits for a copy of it as it is."""
        return any(copy.is_due for copy in self._wanted())

    @property
    def copies_waiting(self) -> int:
        """How many copies of it, as it was, wait to be taken."""
        return sum(copy.is_made for copy in self._wanted())

    @property
    def is_wanted(self) -> bool:
        """Whether somebody waits for a copy of it, which is made or not."""
        return any(copy.is_due or copy.is_made for copy in self._wanted())

    def owe(self) -> OwedCopy:
        """Return a copy of the region as it is now, which is made as late as can be."""
        owed = OwedCopy(self._snapshot)
        self._copies = [*map(ref, self._wanted()), ref(owed)]
        return owed

    def _begin_change(self) -> None:
        for copy in self._wanted():
            copy.make()
        self.is_changed = True

    def _wanted(self) -> list[OwedCopy]:
        """Return the copies that somebody still refers to."""
        return [copy for one in self._copies if (copy := one()) is not None]

    def _snapshot(self) -> RegionSnapshot:
        live = self.evidence.live
        return RegionSnapshot(
            region=region_record(self.index, self.field, live),
            training=self.training.state(),
            table=self.training.rays.table,
            trained=len(self.training.rays.pool),
            setup=self._setup,
        )
