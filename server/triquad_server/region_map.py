"""One region of the live map: its field, its evidence and what it still has to learn."""

import numpy as np
import torch
from numpy.typing import NDArray
from triquad_format.field_settings import FieldSettings
from triquad_format.region import (
    Region,
    RegionIndex,
    TrainingState,
    region_centre,
    voxel_coordinates,
)

from triquad_server.adam import Betas
from triquad_server.engine import GradientSums, make_engine
from triquad_server.evidence import Evidence
from triquad_server.field import Field
from triquad_server.field_record import field_from_record, region_record, training_moments
from triquad_server.replay_pool import ReplayPool
from triquad_server.sampling import Samples
from triquad_server.scan import Rays
from triquad_server.settings import TrainingSettings
from triquad_server.voxel_index import thin

_CARVE_SHORT_M = 0.1
_CHECKPOINT_SAMPLES = 1_000_000


class RegionMap:
    """A region that is being mapped. Everything public is in the map frame."""

    def __init__(
        self,
        index: RegionIndex,
        field_settings: FieldSettings,
        training: TrainingSettings,
        device: torch.device,
        sums: GradientSums,
    ) -> None:
        self.index = index
        self.centre = region_centre(field_settings, index)
        self._settings = field_settings
        self._training = training
        self._device = device
        seed = training.seed + hash(index) % 1_000_003
        self.field = Field(field_settings, device, seed)
        self._engine = make_engine(self.field, sums)
        self.evidence = Evidence(1 << field_settings.depth)
        self.pool = ReplayPool(training.pool_samples, device, seed)
        self.owed = 0  # training visits that new samples have paid for
        self._fresh_owed = 0  # those of them meant for the newest scans
        self.changed = True  # since it was last published

    def covers(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of the points [N, 3] lie in this region's cube."""
        half = self._settings.region_side_m / 2
        return np.asarray((np.abs(points - self.centre) < half).all(axis=1))

    def take_in(self, rays: Rays, samples: Samples) -> None:
        """Learn of a scan: grow the field, note the evidence, keep the samples.

        Samples and end points outside the cube are left out; rays may cross it from anywhere.
        """
        ends = rays.ends[self.covers(rays.ends)]
        self.field.grow(self._local(ends))
        self.evidence.mark_surface(self.voxels(ends))
        all_ends = self.voxels(rays.ends)
        self.evidence.carve(
            self.voxels(rays.origin[None])[0],
            all_ends[thin(all_ends, 1.0)],
            _CARVE_SHORT_M / self._settings.leaf_m,
        )
        inside = self.covers(samples.points)
        if inside.any():
            labels = torch.from_numpy(samples.labels[inside]).to(self._device)
            self.pool.add(self._local(samples.points[inside]), labels)
            visits = int(inside.sum() * self._training.visits)
            self.owed = min(self.owed + visits, self._training.max_backlog)
            self._fresh_owed = int(visits * self._training.fresh_share)
        self.changed = True

    def train(self) -> float:
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
        corners = self._local(np.stack([low, high]))
        self.pool.forget(corners[0], corners[1])
        if len(self.pool) == 0:
            self.owed = 0
        self.changed = True

    def voxels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Voxel coordinates [N, 3] of points."""
        return voxel_coordinates(self._settings, self.centre, points)

    def record(self, training: bool) -> Region:
        """The region as plain arrays, sharing nothing with this one."""
        state = self._training_state() if training else None
        return region_record(self.index, self.field, self.evidence, state)

    @classmethod
    def restore(
        cls,
        record: Region,
        field_settings: FieldSettings,
        training: TrainingSettings,
        device: torch.device,
        sums: GradientSums,
    ) -> "RegionMap":
        """A region from its record; without training state its replay pool starts empty."""
        region = cls(record.index, field_settings, training, device, sums)
        region.field = field_from_record(record, field_settings, device, training.seed)
        region._engine = make_engine(region.field, sums)
        region.evidence = Evidence.restore(1 << field_settings.depth, record.evidence)
        if record.training is not None:
            points = torch.from_numpy(record.training.sample_points.astype(np.float32))
            labels = torch.from_numpy(record.training.sample_labels.astype(np.float32))
            region.pool.add(points.to(device), labels.to(device))
            owed = min(record.training.visits_owed, training.max_backlog)
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

    def _local(self, points: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy((points - self.centre).astype(np.float32)).to(self._device)
