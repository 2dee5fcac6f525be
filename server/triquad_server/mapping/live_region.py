"""One region of the live map: its field, its evidence and what it still has to learn."""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import Region
from triquad_format.records.replay_rays import HELD_OUT
from triquad_map.compiled.evidence.carving import Reach
from triquad_map.compiled.evidence.contradictions import Disbelief
from triquad_map.compiled.evidence.evidence import FrozenEvidence
from triquad_map.compiled.evidence.growth import EvidenceSize, NewEnds
from triquad_map.compiled.evidence.live_evidence import LiveEvidence, Marks
from triquad_map.compiled.evidence.sightings import Sighting
from triquad_map.compiled.surfels.surfel_map import SurfelMap, first_surfels
from triquad_map.compiled.voxel_index import empty_keys, thin
from triquad_map.composition.field_view import field_samples
from triquad_map.composition.region import no_surfels
from triquad_map.places import in_cube
from triquad_map.surface import SampleField, ShownByRays, nothing_shown

from triquad_server.array_memory import buffers_of, bytes_by_part
from triquad_server.engine.field_record import field_from_record, region_record, training_state
from triquad_server.engine.live_field import LiveField, initial_field
from triquad_server.engine.memory import ArrayMemory, FrozenField
from triquad_server.engine.trainer import Loss, trainer_of
from triquad_server.epochs.epoch import FrozenRegion
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.fair_share import FairShare
from triquad_server.mapping.focus import Focus
from triquad_server.mapping.held_out import are_held_out, both_tables
from triquad_server.mapping.judgement import JudgedPlaces, Judgement, Repairs
from triquad_server.mapping.learnt_places import VISITS, LearntPlaces
from triquad_server.mapping.map_snapshot import RegionSnapshot
from triquad_server.mapping.memory_budget import RegionSize
from triquad_server.mapping.ray_table import (
    END,
    RayTable,
    rays_through,
    samples_alone,
)
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay_pool import ReplayPool
from triquad_server.mapping.replay_record import restored_rays
from triquad_server.mapping.slopes import Slopes
from triquad_server.mapping.training_budget import TrainingBudget

_log = logging.getLogger(__name__)

_CARVE_SHORT = 0.5  # voxels before its end a ray shows free space
_CLEAR_SHORT = 2.5
"""So many voxels before its end a ray still shows that a surface is not there."""

_SAMPLES_PER_VOXEL = 16  # that teach the free space of a surface that is gone
_VISITS = 4  # to each of them
_FAR_THINNED_AT, _OPEN_THINNED_AT = 0.5, 0.25  # shares of the rays' length

_VERTICES_PER_SAMPLE = 14
"""Of a region, for each sample of a step: each vertex takes about as many steps wherever it is."""

_LEAST_BATCH = 4096  # what a step costs however few its samples are matters below

_NEW_SCANS = 10
"""So long after it was first seen, the field has had time to learn a surface."""

_FEW_NEW = 2
"""In more voxels than these, new surface makes what was learnt before to be learnt again."""

_SURFELS_REFITTED = 8_000
"""With each epoch while the field is being trained: some 10 ms."""


_JUDGED_AFTER_SAMPLES = 8_000_000
"""A field that is being trained is judged once in so many samples: a few seconds. Where few rays
are kept, it is as soon as each was visited as often as makes a difference."""

_JUDGED_AFTER_SHARE = 0.5
"""A field that has settled is judged once this share of the rays that are held out is new."""

_FEW_GONE = 32
"""Where the surface of more voxels is gone, all of the region learns: rows that others use as well
have to forget it."""


class LiveRegion:
    """A region that is being mapped, by one thread. Everything public is in the map frame."""

    def __init__(
        self, index: RegionIndex, setup: RegionSetup, field: LiveField, evidence: LiveEvidence
    ) -> None:
        self.index = index
        self.centre = setup.field.region_centre(index)
        self.field = field
        self.evidence = evidence
        _, seed = setup.seeds(index)
        self._random = np.random.default_rng(seed)
        # Of its own: free space is recorded beside, by another thread.
        self._ray_random = np.random.default_rng([seed, 1])
        new_pool = partial(
            ReplayPool,
            placement=setup.placement,
            settings=setup.field,
            seed=seed,
            team=setup.team,
        )
        self.pool = new_pool(memory=setup.memory)
        self.held_out = new_pool(memory=ArrayMemory())
        self.places: JudgedPlaces | None = None
        """How well the field fits the rays that are held out, as it was judged last."""

        self.repairs = Repairs()  # so far
        self.learnt = LearntPlaces(setup.field)
        self._judgement = Judgement(setup.field)
        self._field_state = object()  # another one with each step
        self._unjudged_samples = 0  # that were trained since
        self._unjudged_rays = 0  # that were held out since
        self.budget = TrainingBudget(setup.training)
        self._focus = Focus(field, evidence, self.pool)
        self._slopes = Slopes(field, self.pool)
        self.changed = True  # since it was last published
        self._restored = False  # and not published since: where surfaces lie is in the field alone
        self._scans = 0  # that it was seen in
        self._scans_learnt = 0  # of these, those before it was trained last
        self._marks: Marks | None = None  # of the newest
        self._passed: list[Ints] = []  # where rays passed a surface since it was last published
        self._gone: list[Longs] = []  # voxels whose surface went since it was last published
        self._setup = setup
        self._disbelief = Disbelief.of(setup.change.scans, setup.change.doubt)
        self._settings = setup.field
        self._training = setup.training
        self._trainer = trainer_of(field, setup.sums, setup.team)

    @classmethod
    def unseen(cls, index: RegionIndex, setup: RegionSetup) -> "LiveRegion":
        """A region of which nothing is known yet."""
        seed, _ = setup.seeds(index)
        field = initial_field(setup.field, setup.memory, seed)
        return cls(index, setup, field, LiveEvidence(1 << setup.field.depth))

    @classmethod
    def restore(cls, record: Region, setup: RegionSetup) -> "LiveRegion":
        """A region from its record; without training state its replay pool starts empty."""
        seed, _ = setup.seeds(record.index)
        field = field_from_record(record, setup.field, setup.memory, seed=seed)
        evidence = LiveEvidence.from_record(1 << setup.field.depth, record.evidence)
        region = cls(record.index, setup, field, evidence)
        region._restored = True
        state = record.training
        if state is not None:
            region._keep(restored_rays(state.rays, setup.field, setup.team))
            region.pool.add(samples_alone(state.sample_points, state.sample_labels))
            region.budget.restore(state.budget_samples, len(region.pool))
            region.repairs = Repairs(state.places_repaired, state.places_given_up)
            # What it forgets from now on is told from what it knows now.
            region._judge(region.field.freeze())
        return region

    @property
    def size(self) -> RegionSize:
        """How much it holds."""
        return RegionSize(self.evidence.size, self.field.vertices)

    def new_ends(self, rays: ScanRays) -> NewEnds:
        """The voxels in which rays would end for the first time."""
        return self.evidence.new_ends(self.voxels(rays.ends))

    def growth_by(self, rays: ScanRays) -> RegionSize:
        """What the rays would add to it; of the space that they cross, an estimate."""
        origin = self.voxels(rays.origin[None])[0]
        new = self.new_ends(rays)
        ways = self.voxels(np.concatenate([rays.ends, rays.free_corners]))
        blocks = self.evidence.new_blocks(origin, ways)
        size = EvidenceSize(blocks, new.blocks, len(new.voxels))
        return RegionSize(size, self.field.growth_by(new.voxels))

    def see(self, rays: ScanRays, stamp_s: int) -> Callable[[], None]:
        """Record where the rays ended, and grow the field there; outside the cube nothing is.

        Returns:
            What records the free space that the rays crossed, wherever they come from and end. It
            may run beside :meth:`learn`.
        """
        ends = self.voxels(rays.ends)
        origin = self.voxels(rays.origin[None])[0]
        self._scans += 1
        leaf_m = self._settings.leaf_m
        sighting = Sighting(origin, leaf_m, stamp_s, self._scans)
        self._marks = self.evidence.mark_surface(ends, sighting)
        # A leaf of the trees is the shadow of a voxel: where a ray ended before, nothing grows.
        self.field.grow(self._marks.new)
        if len(self.learnt) and self.evidence.new_surface(self._marks, _NEW_SCANS) > _FEW_NEW:
            self.learnt.learn_all_again()
        if self.budget.samples == 0:
            self._focus.narrow()
        offsets = rays.ends - self.centre
        self.learnt.see(offsets)
        self._focus.widen_to(ends[self.learnt.owing(offsets)])
        self.changed = True
        clear = math.inf if self._setup.change.static else _CLEAR_SHORT
        reach = Reach(_CARVE_SHORT, clear, self._scans)

        def carve() -> None:
            thinned = ends[thin(ends, 1.0, empty_keys(len(ends)))]
            far_ends = self._thinned_open(origin, rays.far_ends, _FAR_THINNED_AT)
            passed = self.evidence.carve(origin, thinned, reach)
            passed_farther = self.evidence.carve(origin, far_ends, reach._replace(free=0.0))
            self._doubt(np.concatenate([passed, passed_farther]))
            # Glass and black paint return nothing: these rays contradict no surface.
            open_ends = self._thinned_open(origin, rays.open_ends, _OPEN_THINNED_AT)
            self.evidence.carve(origin, open_ends, Reach(0.0))
            if rays.robot is not None:
                self.evidence.mark_free(self.voxels(rays.robot.voxel_centres(leaf_m)))

        return carve

    def _doubt(self, passed: Ints) -> None:
        """Take back the surface that rays contradict; ``passed`` is where they passed one."""
        if len(passed):
            self._passed.append(passed)
            self._gone.append(self.evidence.take_back(passed, self._disbelief))

    def _thinned_open(self, origin: Doubles, ends: Doubles, share: float) -> Doubles:
        """Some of the rays to ``ends`` [N, 3], map frame, as voxels: they go as far as can be.

        One per voxel at a share of their length: nearer, they leave no gaps. The voxels are
        shifted from scan to scan, so that a robot at rest uses other rays each time.
        """
        reached = self.voxels(ends)
        near = origin + share * (reached - origin) + self._random.random(3)
        thinned: Doubles = reached[thin(near, 1.0, empty_keys(len(reached)))]
        return thinned

    def learn(self, rays: ScanRays, normals: Doubles) -> None:
        """Keep what the rays teach, to be trained on.

        ``normals`` [N, 3] are those at the rays' ends, NaN where unknown.
        """
        passing = rays_through(rays, normals, self.centre, self.pool.placement, self._ray_random)
        if len(passing) == 0:
            return
        held = self._keep(passing)
        owing = self.learnt.owing(passing.rows[:, END : END + 3])
        self.budget.add(int((owing & ~held).sum()))

    def _keep(self, rays: RayTable) -> Bools:
        """Keep rays [N]; returns which of them are held out."""
        held = are_held_out(rays.rows, self._settings)
        self.held_out.add(rays.of(held))
        self.pool.add(rays.of(~held))
        self._unjudged_rays += int(held.sum())
        return held

    def limit(self, share: FairShare) -> None:
        """From now on, keep as many rays and owe as many samples as are its share."""
        voxels = self.size.evidence.voxels
        rays = max(1, int(share.rays * voxels))
        self.pool.limit(rays)
        self.held_out.limit(max(1, rays // HELD_OUT))
        self.budget.limit(int(share.samples * voxels))

    def ray_ends(self) -> Doubles:
        """Where the rays end [N, 3] that are kept, those of the newest scans last."""
        table = self.pool.table
        rays = np.argsort(table.origin_of, kind="stable")[(table.origin_of < 0).sum() :]
        ends: Doubles = table.rows[rays, END : END + 3] + self.centre
        return ends

    def set_normals(self, normals: Doubles) -> None:
        """Keep the unit normals [N, 3] at the ends of the newest scan's rays; NaN where unknown.

        Not beside what :meth:`see` returned.
        """
        if self._marks is not None:
            self.evidence.set_normals(self._marks, normals)
            self._marks = None  # with the room for those of all its rays

    @property
    def owed(self) -> float:
        """Samples that are still to be trained on for each vertex."""
        return self.budget.samples / max(1, self.field.vertices)

    @property
    def batch(self) -> int:
        """Samples of a step: fewer where little learns, or it would take too few steps.

        And half while scans stream in: of as many samples, more and smaller steps learn sooner.
        """
        most = self._training.batch
        wanted = min(most, self.field.vertices_that_learn // _VERTICES_PER_SAMPLE)
        if self.budget.learns_newest:
            wanted //= 2
        return min(most, max(_LEAST_BATCH, wanted))

    def train(self) -> Loss:
        """One optimiser step; returns the loss: to read it on a GPU waits for the step."""
        self._focus.apply(self.batch)
        step = self.budget.next_step(self.batch, self.pool.rays_drawn_on)
        batch = self.pool.draw(step.samples, step.fresh, step.repair)
        loss = self._trainer.train(batch, step.rates)
        self.budget.spend(step)
        self._field_state = object()
        self._scans_learnt = self._scans
        self._unjudged_samples += step.samples
        self.learnt.trained(step.samples / self.pool.rays_drawn_on)
        self._slopes.after(step)
        self.changed = True
        return loss

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Forget evidence and samples between two corners [3]."""
        self._focus.release()
        self.learnt.learn_all_again()
        self.evidence.clear(self.voxels(low[None])[0], self.voxels(high[None])[0])
        for pool in (self.pool, self.held_out):
            pool.forget(low - self.centre, high - self.centre)
        if len(self.pool) == 0:
            self.budget.clear()
        self.changed = True

    def voxels(self, points: Doubles) -> Doubles:
        """Voxel coordinates [N, 3] of points."""
        return self._settings.leaf_coordinates(points - self.centre)

    def freeze(self, epoch: int, before: FrozenRegion | None) -> FrozenRegion:
        """The region as it is now, to be published with ``epoch``.

        ``before`` is how it was published last: what did not change is shared with it.
        """
        self.changed = False
        fitted_to = None if self.budget.samples else self._field_state
        field = self.field.freeze()
        samples = field_samples(field, self._settings, self._setup.team.split)
        if self._passed:
            passed, rule = np.concatenate(self._passed), self._disbelief
            self._gone.append(self.evidence.take_back_unseen(passed, rule, samples))
            self._passed.clear()
        evidence = self.evidence.freeze(self._setup.team.split)
        surfels = self._surfels(evidence, samples, epoch, before)
        if self._restored:
            self.evidence.set_discs(surfels.voxels(), surfels.surfels)
            self._restored = False
        self._forget_gone(surfels)
        if self._is_to_be_judged:
            self._judge(field)
        own = buffers_of((field, evidence, surfels))
        live = {
            "field": self.field,
            "evidence": self.evidence,
            "replay_pools": (self.pool, self.held_out),
        }
        return FrozenRegion(
            index=self.index,
            centre=self.centre,
            engine=field,
            evidence=evidence,
            surfels=surfels,
            vertices=self.field.vertices,
            parameters=self.field.parameters,
            changed=epoch,
            surfels_fitted_to=fitted_to,
            live_bytes=bytes_by_part(live, without=own),
            buffers=own,
        )

    def snapshot(self) -> RegionSnapshot:
        """The region as it is now, sharing nothing with this one."""
        state = replace(
            training_state(self.field, self.budget.samples),
            places_repaired=self.repairs.done,
            places_given_up=self.repairs.given_up,
        )
        return RegionSnapshot(
            region=region_record(self.index, self.field, self.evidence, training=None),
            training=state,
            table=both_tables(self.pool.table, self.held_out.table),
            trained=len(self.pool),
            placement=self._setup.placement,
            settings=self._settings,
            team=self._setup.team,
        )

    @property
    def _is_to_be_judged(self) -> bool:
        if self.budget.samples:
            enough = min(_JUDGED_AFTER_SAMPLES, VISITS * len(self.pool))
            return self._unjudged_samples >= enough
        new = self._unjudged_rays >= _JUDGED_AFTER_SHARE * len(self.held_out)
        return self._unjudged_samples > 0 or new

    def _judge(self, field: FrozenField) -> None:
        """Find out where the field has forgotten what it knew, and have it learnt again."""
        self._unjudged_samples = self._unjudged_rays = 0
        rows = self.held_out.table.rows
        rows = rows[in_cube(rows[:, END : END + 3], self._settings)]
        if len(rows) == 0:
            return
        ends = np.ascontiguousarray(rows[:, END : END + 3])

        def at_ends(points: Floats) -> Floats:
            return field.evaluate(points, gradient=False).sdf

        sdf = at_ends(ends)
        self.places = places = self._judgement.judge(rows, sdf, may_repair=self.budget.may_repair)
        rose = self.learnt.judge(ends, sdf, at_ends, settled=self.budget.samples == 0)
        self.repairs = self.repairs.after(places)
        if len(places.forgotten_keys):
            x, y, z = places.centres[places.forgotten][0] + self.centre
            _log.info(
                "%d places fit held-out rays worse than before, and are learnt again: one is at "
                "%.1f, %.1f, %.1f",
                len(places.forgotten_keys),
                x,
                y,
                z,
            )
        attended = self.pool.attend(places.forgotten_keys)
        if attended or rose:
            self._focus.release()
        self.budget.repair(attended)

    def _surfels(
        self, evidence: FrozenEvidence, field: SampleField, epoch: int, before: FrozenRegion | None
    ) -> SurfelMap:
        """The surfels of an epoch; once a region has settled, all are fitted to its field."""
        most: int | None = None
        shown: ShownByRays = nothing_shown
        is_fitted = before is not None and before.surfels_fitted_to is self._field_state
        if self.budget.samples or is_fitted:
            most = _SURFELS_REFITTED if self.budget.samples else 0
            since = max(1, self._scans_learnt - _NEW_SCANS)  # and not of before a restart
            shown = partial(self.evidence.ray_surfels, since=since)
        if before is None:
            return first_surfels(evidence, field, epoch, shown)
        return before.surfels.updated(evidence, field, epoch, most=most, by_rays=shown)

    def _forget_gone(self, surfels: SurfelMap) -> None:
        """Unlearn the surface that was taken back: its rays, and what the field shows there."""
        if not any(len(voxels) for voxels in self._gone):
            self._gone.clear()
            return
        voxels = np.unique(np.concatenate(self._gone), axis=0)
        self._gone.clear()
        voxels = voxels[~self.evidence.freeze().ended_in(voxels)]  # nothing ended there since
        self.learnt.lose(self._settings.offsets(voxels.astype(np.float64) + 0.5))
        for pool in (self.pool, self.held_out):
            pool.forget_ends(voxels)
        if len(voxels) > _FEW_GONE:
            self._focus.release()
        else:
            self._focus.widen_to(voxels)
        inside = self._random.random((_SAMPLES_PER_VOXEL, len(voxels), 3))
        points = (voxels + inside).reshape(-1, 3)
        leaf_m = self._settings.leaf_m
        nearest = no_surfels(np.full(len(points), self._setup.scan.truncation_m / leaf_m))
        surfels.find_nearest(points, nearest)
        offsets = self._settings.offsets(points).astype(np.float32)
        self.pool.add(samples_alone(offsets, nearest.distances * leaf_m), fresh=False)
        self.budget.add_samples(_VISITS * len(points))
