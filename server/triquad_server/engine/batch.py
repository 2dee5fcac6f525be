"""What one step of training learns from."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """Samples to train on."""

    points: Tensor  # [B, 3] metres from the region's centre
    labels: Tensor  # [B] signed distances, metres
