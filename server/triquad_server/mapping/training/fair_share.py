"""What each voxel with surface has of the rays that are kept and of the training that is left."""

import math
from dataclasses import dataclass

from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.settings import TrainingSettings

_STEP = 1.1
"""By which the rays of a voxel become fewer: it is expensive, and so it is done seldom."""


@dataclass(frozen=True)
class FairShare:
    """What a voxel with surface has, wherever it is, so that all places are learnt alike."""

    rays: float  # that are kept
    samples: float  # that may be left to train on
    rays_share: float  # of `training.rays_per_voxel`, that memory has room for

    @classmethod
    def of(cls, voxels: int, training: TrainingSettings) -> "FairShare":
        """The share in a map of so many ``voxels`` with surface."""
        count = max(1, voxels)
        wanted = max(training.pool_rays / count, training.rays_per_voxel)
        kept = min(wanted, training.pool_bytes / RAY_BYTES / count)
        return cls(
            rays=_STEP ** math.floor(math.log(kept, _STEP)),
            samples=max(training.max_budget_samples / count, training.samples_per_voxel),
            rays_share=min(1.0, kept / training.rays_per_voxel),
        )
