"""What each voxel with surface has of the rays that are kept and of the training that is owed."""

import math
from dataclasses import dataclass

from triquad_server.mapping.replay_pool import RAY_BYTES
from triquad_server.settings import TrainingSettings

_STEP = 1.1
"""By which the rays of a voxel become fewer: it is expensive, and so it is done seldom."""

_RECORDED = 7.0
"""Rays of a voxel in a checkpoint: fewer than are kept, since what they taught is in it as well."""


@dataclass(frozen=True)
class FairShare:
    """What a voxel with surface has, wherever it is, so that all places are learnt alike."""

    rays: float  # that are kept
    recorded_rays: float  # that a checkpoint has of these, at most
    samples: float  # that may be owed
    rays_share: float  # of `training.rays_per_voxel`, that memory has room for

    @classmethod
    def of(cls, voxels: int, training: TrainingSettings) -> "FairShare":
        """The share in a map of so many ``voxels`` with surface."""
        count = max(1, voxels)
        always = training.pool_rays / count
        wanted = max(always, training.rays_per_voxel)
        kept = min(wanted, training.pool_bytes / RAY_BYTES / count)
        return cls(
            rays=_STEP ** math.floor(math.log(kept, _STEP)),
            recorded_rays=max(always, _RECORDED),
            samples=max(training.max_budget_samples / count, training.samples_per_voxel),
            rays_share=min(1.0, kept / training.rays_per_voxel),
        )
