"""One region of the live map: its field, its evidence and what it still has to learn."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    Region,
    RegionIndex,
    TrainingState,
    leaf_coordinates,
    region_centre,
)
from triquad_map.compiled.evidence.live_evidence import LiveEvidence
from triquad_map.compiled.evidence.observations import Sighting
from triquad_map.compiled.sparse.thinning import thin

from triquad_server.engine.adam import Betas
from triquad_server.engine.engine import GradientSums, Loss, make_engine
from triquad_server.engine.field import Field
from triquad_server.engine.field_record import field_from_record, region_record, training_moments
from triquad_server.intake.scan import Rays
from triquad_server.mapping.ray_labels import ray_segments, sample_segments
from triquad_server.mapping.replay_pool import ReplayPool
from triquad_server.mapping.sampling import Placement
from triquad_server.settings import ScanSettings, TrainingSettings

_CARVE_SHORT_M = 0.1
_CHECKPOINT_SAMPLES = 1_000_000


@dataclass(frozen=True)
class RegionSetup:
    """What the regions of a map have in common."""

    field: FieldSettings
    scan: ScanSettings
    training: TrainingSettings
    device: torch.device
    sums: GradientSums


class RegionMap:
    """A region that is being mapped. Everything public is in the map frame."""

    def __init__(self, index: RegionIndex, setup: RegionSetup) -> None:
        self.index = index
        self.centre = region_centre(setup.field, index)
        self._setup = setup
        self._settings = setup.field
        self._training = setup.training
        seed = setup.training.seed + hash(index) % 1_000_003
        self.field = Field(setup.field, setup.device, seed)
        self._engine = make_engine(self.field, setup.sums)
        self.evidence = LiveEvidence(1 << setup.field.depth)
        placement = Placement(
            setup.scan.surface_share,
            setup.scan.spread_m,
            setup.scan.truncation_m,
            setup.field.region_side_m / 2,
        )
        self.pool = ReplayPool(setup.training.pool_segments, placement, setup.device, seed)
        self.owed = 0  # training visits that new segments have paid for
        self._fresh_owed = 0  # those of them meant for the newest scans
        self.changed = True  # since it was last published

    def see(self, rays: Rays, stamp_s: int) -> Callable[[], None]:
        """Note where the rays ended, and grow the field there; outside the cube nothing is.

        Returns:
            What notes the free space that the rays crossed, wherever they come from and end. It
            may run beside :meth:`learn`.
        """
        ends = self.voxels(rays.ends)
        origin = self.voxels(rays.origin[None])[0]
        sighting = Sighting(origin, self._settings.leaf_m, stamp_s)
        new = self.evidence.mark_surface(ends, sighting)
        # A leaf of the trees is the shadow of a voxel: where a ray ended before, nothing grows.
        self.field.grow(new)
        self.changed = True
        short = _CARVE_SHORT_M / self._settings.leaf_m
        return lambda: self.evidence.carve(origin, ends[thin(ends, 1.0)], short)

    def learn(self, rays: Rays, normals: NDArray[np.float64]) -> None:
        """Keep what the rays teach, to be trained on.

        ``normals`` [N, 3] are those at the rays' ends, NaN where unknown.
        """
        half = self._settings.region_side_m / 2
        segments = ray_segments(rays, normals, self.centre, half, self._setup.scan)
        if len(segments) == 0:
            return
        self.pool.add(segments)
        visits = int(len(segments) * self._training.visits)
        self.owed = min(self.owed + visits, self._training.max_backlog)
        self._fresh_owed = int(visits * self._training.fresh_share)

    def train(self) -> Loss:
        """One optimiser step; returns the loss."""
        settings = self._training
        fresh = min(self._fresh_owed, int(settings.batch * settings.fresh_share))
        batch = self.pool.draw(settings.batch, fresh)
        rate = settings.learning_rate * self._cooling()
        betas = Betas(settings.beta1, settings.beta2)
        loss = self._engine.train(batch, rate, betas)
        self._fresh_owed -= fresh
        self.owed = max(0, self.owed - settings.batch)
        self.changed = True
        return loss

    def forget(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Forget evidence and samples between two corners [3]."""
        self.evidence.clear(self.voxels(low[None])[0], self.voxels(high[None])[0])
        self.pool.forget(low - self.centre, high - self.centre)
        if len(self.pool) == 0:
            self.owed = 0
        self.changed = True

    def voxels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Voxel coordinates [N, 3] of points."""
        return leaf_coordinates(self._settings, points - self.centre)

    def record(self, training: bool) -> Region:
        """The region as plain arrays, sharing nothing with this one."""
        state = self._training_state() if training else None
        return region_record(self.index, self.field, self.evidence.freeze(), state)

    @classmethod
    def restore(cls, record: Region, setup: RegionSetup) -> "RegionMap":
        """A region from its record; without training state its replay pool starts empty."""
        region = cls(record.index, setup)
        region.field = field_from_record(record, setup.field, setup.device, setup.training.seed)
        region._engine = make_engine(region.field, setup.sums)
        region.evidence = LiveEvidence.from_record(1 << setup.field.depth, record.evidence)
        if record.training is not None:
            state = record.training
            segments = sample_segments(state.sample_points, state.sample_labels)
            region.pool.add(segments)
            owed = min(state.visits_owed, setup.training.max_backlog)
            region.owed = owed if len(region.pool) else 0
        return region

    def _training_state(self) -> TrainingState:
        moments = training_moments(self.field)
        samples = self.pool.sample(_CHECKPOINT_SAMPLES)
        return TrainingState(
            **moments.as_fields(),
            sample_points=samples.points.cpu().numpy(),
            sample_labels=samples.labels.cpu().numpy().astype(np.float16),
            visits_owed=self.owed,
        )

    def _cooling(self) -> float:
        """Share of the learning rate: falls as less is owed, so that the field settles."""
        return min(1.0, max(0.02, self.owed / (self._training.cooldown * max(1, len(self.pool)))))
