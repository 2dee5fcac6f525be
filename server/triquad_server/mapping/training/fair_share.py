"""Each voxel's share of the rays that are kept and of the training that is left."""

import math
from dataclasses import dataclass

from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.settings import TrainingSettings

_STEP = 1.1
"""The factor between the possible numbers of rays per voxel: changing it is expensive, so it is
done seldom."""


@dataclass(frozen=True)
class FairShare:
    """The share of a voxel with surface, the same everywhere: all places are learnt alike."""

    rays: float  # rays that are kept
    samples: float  # samples that may be left to train on
    rays_share: float  # share of `training.rays_per_voxel` that memory has room for

    @classmethod
    def of(cls, voxels: int, training: TrainingSettings) -> "FairShare":
        """Return the share in a map of ``voxels`` voxels with surface."""
        count = max(1, voxels)
        wanted = max(training.pool_rays / count, training.rays_per_voxel)
        kept = min(wanted, training.pool_bytes / RAY_BYTES / count)
        return cls(
            rays=_STEP ** math.floor(math.log(kept, _STEP)),
            samples=max(training.max_budget_samples / count, training.samples_per_voxel),
            rays_share=min(1.0, kept / training.rays_per_voxel),
        )
