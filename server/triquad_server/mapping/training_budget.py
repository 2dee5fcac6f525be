"""A region's budget of training: how many samples, on which rays, and at which rates."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from triquad_server.engine.live_field import Rates
from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.settings import TrainingSettings

_STEP = 1.1
"""The factor between the possible numbers of rays per voxel: changing it is expensive, so it is
done seldom."""

_MOST_PER_RAY = 20.0
"""Samples that may be left, for each ray that the map is to keep."""


@dataclass(frozen=True)
class FairShare:
    """The share of a voxel with surface, the same everywhere: all places are learnt alike."""

    rays: float  # rays that are kept
    samples: float  # samples that may be left to train on
    rays_share: float  # share of `training.rays_per_voxel` that memory has room for

    @classmethod
    def of(cls, voxels: int, training: TrainingSettings) -> "FairShare":
        """Return the share in a map of ``voxels`` voxels with surface."""
        wanted = training.rays_per_voxel
        kept = min(wanted, training.pool_bytes / RAY_BYTES / max(1, voxels))
        return cls(
            rays=_STEP ** math.floor(math.log(kept, _STEP)),
            samples=_MOST_PER_RAY * wanted,
            rays_share=kept / wanted,
        )


_LEAST_RATE = 0.02
"""The share of the learning rate with which the last samples are trained."""

_COOLDOWN = 8.0
"""Samples left per ray below which the learning rate falls. From 16 on, a street at 16 beams is
learnt to 0.85 cm instead of 0.80."""


class Step(NamedTuple):
    """The next step of the optimiser."""

    samples: int
    fresh: int  # of them, on rays of the newest scan
    rates: Rates


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

    def restore(self, samples: int, rays: int) -> None:
        """Go on with ``samples`` from a record, on ``rays`` rays."""
        self.samples = samples if rays else 0

    def limit(self, most: int) -> None:
        """From now on, at most ``most`` samples are left."""
        self._most = most
        too_many = max(0, self.samples - most)
        self.samples -= too_many
        self.discarded += too_many

    def clear(self) -> None:
        """Leave nothing to learn."""
        self.samples = 0

    def next_step(self, count: int, kept_rays: int) -> Step:
        """Return a step of ``count`` samples, where ``kept_rays`` rays are kept."""
        settings = self._settings
        fresh = min(self._fresh, int(count * settings.fresh_share))
        return Step(count, fresh, Rates(settings.learning_rate * self._cooling(kept_rays)))

    def spend(self, step: Step) -> None:
        """Record that a step was taken."""
        self.samples = max(0, self.samples - step.samples)
        # A tiny share gives no batch a whole sample: the rest ends with the budget.
        self._fresh = self._fresh - step.fresh if self.samples else 0

    def _cooling(self, rays: int) -> float:
        """Return the share of the learning rate: it falls with the budget, so the field settles."""
        enough = max(1.0, _COOLDOWN * rays)
        return min(1.0, max(_LEAST_RATE, (self.samples / enough) ** 2))
