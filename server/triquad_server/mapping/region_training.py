"""Training of one region of the live map: what it still has to learn, and how well it fits."""

import math
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.region import TrainingState
from triquad_map.compiled.voxel_index import keys_of
from triquad_map.field.frozen_field import FrozenField
from triquad_map.field_fit import PlaceFits
from triquad_map.surfels.surfel_map import SurfelMap
from triquad_map.surfels.surfel_search import no_surfels

from triquad_server.engine.compiled_trainer import Loss, trainer_of
from triquad_server.engine.field_record import training_state
from triquad_server.engine.live_field import LiveField
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay.ray_table import rays_through, samples_alone
from triquad_server.mapping.replay.region_rays import RegionRays
from triquad_server.settings import TrainingSettings

_VERTICES_PER_SAMPLE = 14
"""The vertices for each sample of a step: each vertex takes about as many steps in any region. With
4,096 samples at least, a room is learnt to 0.33 cm after 3 million, not 0.29."""

_LEAST_BATCH = 256  # steps of fewer samples take nearly as long

_JUDGED_AFTER_SAMPLES = 8_000_000
"""A field is judged after this many samples, a few seconds, and once it has settled."""

_SLOPES_EVERY_SAMPLES = 1 << 15  # samples after which the field is asked for slopes of rays
_SLOPES_SHARE = 0.25
"""The share of the samples that are rays without a normal, whose slope follows the field. Without
any, a street at 16 beams settles at 0.74 cm instead of 0.60."""

LEARNT_SCANS = 50
"""A surface is new for this many scans: a drive at 1 m a scan leaves it behind earlier."""

_NEW_SHARE = 0.01
"""A scan owes training once as many rays as this share of its own ended on new surface. The others
show what is still there, but teach little: so the map of a robot at rest settles while scans come,
though single rays always end, by chance, where none has ended before."""

_LEAST_RATE = 0.02
"""The share of the learning rate with which the last samples are trained."""

_COOLDOWN = 8.0
"""Samples left per ray below which the learning rate falls. From 16 on, a street at 16 beams is
learnt to 0.85 cm instead of 0.80."""


class Step(NamedTuple):
    """The next step of the optimiser."""

    samples: int
    fresh: int  # of them, on rays of the newest scan
    learning_rate: float


class TrainingBudget:
    """Counts samples that are still to be trained on; new rays add to it, each step spends some."""

    def __init__(self, settings: TrainingSettings) -> None:
        self._settings = settings
        self.samples = 0
        self.discarded = 0  # samples so far beyond the limit of what may be left
        self._most = 0  # limit of what may be left
        self._fresh = 0  # of the samples, those that are to be on rays of the newest scan

    @property
    def learns_newest(self) -> bool:
        """Return whether rays of the newest scan have yet to be learnt from."""
        return self._fresh > 0

    def add(self, rays: int) -> None:
        """Add new rays to learn from."""
        samples = int(rays * self._settings.samples_per_ray)
        self._fresh = int(samples * self._settings.fresh_share)
        self.samples += samples
        self.limit(self._most)

    def add_samples(self, samples: int) -> None:
        """Add samples on what is known; without effect once nothing is left."""
        if self.samples:
            self.samples += samples

    def limit(self, most: int) -> None:
        """From now on, at most ``most`` samples are left."""
        self._most = most
        too_many = max(0, self.samples - most)
        self.samples -= too_many
        self.discarded += too_many

    def next_step(self, count: int, kept_rays: int) -> Step:
        """Return a step of ``count`` samples, where ``kept_rays`` rays are kept."""
        settings = self._settings
        fresh = min(self._fresh, int(count * settings.fresh_share))
        return Step(count, fresh, settings.learning_rate * self._cooling(kept_rays))

    def spend(self, step: Step) -> None:
        """Record that a step was taken."""
        self.samples = max(0, self.samples - step.samples)
        # A tiny share gives no batch a whole sample: the rest ends with the budget.
        self._fresh = self._fresh - step.fresh if self.samples else 0

    def _cooling(self, rays: int) -> float:
        """Return the share of the learning rate: it falls with the budget, so the field settles."""
        enough = max(1.0, _COOLDOWN * rays)
        return min(1.0, max(_LEAST_RATE, (self.samples / enough) ** 2))


class RegionTraining:
    """Trains one region's field; it is notified of scans, and must be notified of epochs."""

    def __init__(
        self,
        field: LiveField,
        setup: RegionSetup,
        centre: Doubles,
        seed: int,
        state: TrainingState | None = None,
    ) -> None:
        """Continue as recorded, or begin with nothing to learn.

        Args:
            field: what is trained.
            setup: what all regions have in common.
            centre: [3] of the region, map frame.
            seed: of all random choices.
            state: that of a record, if any.
        """
        self._field = field
        self._setup = setup
        self._centre = centre
        self._random = np.random.default_rng([seed, 1])  # other numbers than those of the pool
        self.rays = RegionRays(setup, seed, state)
        self.budget = TrainingBudget(setup.training)
        self.fit: PlaceFits | None = None  # to the rays that are held out, as judged last
        self._trainer = trainer_of(field, setup.sums, setup.team)
        self._unjudged_samples = 0  # samples that were trained since it was judged
        self._unasked_samples = 0  # samples that were trained since slopes were set by the field
        self._unlearnt: Longs = np.zeros(0, np.int64)  # keys of voxels whose surface was removed
        self._new_rays = 0  # that ended on new surface since the last scan that owed training
        if state is not None:
            self.budget.samples = state.budget_samples if len(self.rays.pool) else 0
            self._judge(field.freeze())

    @property
    def is_settled(self) -> bool:
        """Return whether there is nothing left to train on."""
        return self.budget.samples == 0

    @property
    def samples_per_vertex(self) -> float:
        """The number of samples that are still to be trained on for each vertex."""
        return self.budget.samples / max(1, self._field.vertices)

    @property
    def batch(self) -> int:
        """The samples of a step: fewer where vertices are few, or it would take too few steps.

        They are halved while scans stream in: smaller steps learn sooner from as many samples.
        """
        most = self._setup.training.batch
        wanted = min(most, self._field.vertices // _VERTICES_PER_SAMPLE)
        if self.budget.learns_newest:
            wanted //= 2
        return min(most, max(_LEAST_BATCH, wanted))

    def limit(self, rays: int, samples: int) -> None:
        """Keep at most as many rays to train on, with as many samples left."""
        self.rays.limit(rays)
        self.budget.limit(samples)

    def surface_appeared(self, voxels: Longs) -> None:
        """Forget what was taught of free space in voxels [M, 3] that have surface now."""
        again = voxels[np.isin(keys_of(voxels), self._unlearnt)]
        if len(again):
            self._unlearnt = np.setdiff1d(self._unlearnt, keys_of(again))
            self.rays.forget_ends(again)

    def scan_taken(self, rays: ScanRays, normals: Doubles, used: Bools, is_new: Bools) -> None:
        """Keep the rays of a scan, to be trained on.

        Args:
            rays: N rays, map frame.
            normals: [N, 3] of the surface at their ends, NaN where unknown.
            used: [N] which of them are kept.
            is_new: [N] which of these end on new surface.
        """
        self._new_rays += int(is_new.sum())
        shows_new = self._new_rays > _NEW_SHARE * int(used.sum())
        if shows_new:
            self._new_rays = 0
        placement = self._setup.placement
        passing = rays_through(rays, normals, used, self._centre, placement, self._random)
        if len(passing) == 0:
            return
        held = self.rays.keep(passing)
        self.budget.add(int((~held).sum()) if shows_new else 0)

    def take_step(self) -> tuple[Loss, int]:
        """Take one optimiser step; return loss and samples. On a GPU, reading the loss waits."""
        step = self.budget.next_step(self.batch, len(self.rays.pool))
        loss = self._trainer.train(self.rays.draw(step.samples, step.fresh), step.learning_rate)
        self.budget.spend(step)
        self._unjudged_samples += step.samples
        self._unasked_samples += step.samples
        if self._unasked_samples >= _SLOPES_EVERY_SAMPLES:
            count = int(_SLOPES_SHARE * self._unasked_samples)
            self.rays.set_slopes(self._field, count, count * step.fresh // step.samples)
            self._unasked_samples = 0
        return loss, step.samples

    def published(self, field: FrozenField, surfels: SurfelMap, removed: Longs) -> None:
        """Use a published epoch: its ``field``, its ``surfels``, and voxels ``removed`` [M, 3].

        These had surface in the epoch before, and have none now. The field is judged from time to
        time.
        """
        if len(removed):
            self._unlearn(removed, surfels)
        if self._is_to_be_judged:
            self._judge(field)

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Forget the rays that end between two corners [3], map frame."""
        self.rays.forget(low - self._centre, high - self._centre)
        if len(self.rays.pool) == 0:
            self.budget.samples = 0

    def state(self) -> TrainingState:
        """Return what training needs beyond the field, rays and samples, as copies."""
        return training_state(self._field, self.budget.samples)

    def _unlearn(self, removed: Longs, surfels: SurfelMap) -> None:
        """Forget the rays that ended in voxels, and have the field learn what is there now.

        It learns it from as many samples as a voxel with surface has rays, each as often as a ray.
        """
        settings, training = self._setup.field, self._setup.training
        self.rays.forget_ends(removed)
        self._unlearnt = np.union1d(self._unlearnt, keys_of(removed))
        count = math.ceil(training.rays_per_voxel)
        inside = self._random.random((count, len(removed), 3))
        points = (removed + inside).reshape(-1, 3)
        nearest = no_surfels(np.full(len(points), self._setup.scan.behind_m / settings.leaf_m))
        surfels.find_nearest(points, nearest)
        offsets = settings.offsets(points).astype(np.float32)
        samples = samples_alone(offsets, nearest.distances * settings.leaf_m)
        self.rays.pool.add(samples)
        self.budget.add_samples(int(training.samples_per_ray * len(points)))

    @property
    def _is_to_be_judged(self) -> bool:
        if self.is_settled:
            return self._unjudged_samples > 0 or self.fit is None
        return self._unjudged_samples >= _JUDGED_AFTER_SAMPLES

    def _judge(self, field: FrozenField) -> None:
        """Find how well the field fits the rays that are held out: it should be zero at their ends.

        The error there includes the sensor's noise.
        """
        self._unjudged_samples = 0
        ends = self.rays.judging_ends
        if len(ends):
            sdf = field.evaluate(ends, gradient=False).sdf
            self.fit = PlaceFits.of(ends, self._setup.field, sdf)
