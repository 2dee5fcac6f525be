"""The field of one region: interpolated features and Fourier features, decoded by a small MLP.

3QFP, section III: the feature vectors of the vertices around a point are interpolated, summed over
the three planes and concatenated over the levels; Gaussian Fourier features of the coordinates
are appended; the MLP turns both into a logit, which is the signed distance in units of
``logit_scale_m``. Positive is free space.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.field.quadtree import FrozenQuadtree, LiveQuadtree

from triquad_server.engine.adam import Betas, Parameter
from triquad_server.engine.corners import CornerIndex, Corners


class Field:
    """A differentiable signed-distance field over a region's cube.

    Points are float32 [N, 3], metres from the region's centre.
    """

    def __init__(self, settings: FieldSettings, device: torch.device, seed: int) -> None:
        self.settings = settings
        self._generator = torch.Generator(device).manual_seed(seed)
        self.device = device
        self._growing = LiveQuadtree(settings)
        self.tree: LiveQuadtree | FrozenQuadtree = self._growing
        self._corners: CornerIndex | None = None
        self.features = Parameter(torch.zeros((1, settings.feature_size), device=device))
        self.frequencies = self._normal(settings.frequencies) * math.sqrt(
            settings.frequency_variance,
        )
        self.mlp = [Parameter(weight[None]) for weight in self._new_mlp()]

    @property
    def parameters(self) -> int:
        """Learnable numbers."""
        features = (len(self.features) - 1) * self.settings.feature_size
        return features + sum(part.values.numel() for part in self.mlp)

    @property
    def vertices(self) -> int:
        """Vertices on all planes and levels."""
        return len(self.features) - 1

    def grow(self, leaves: NDArray[np.int64]) -> None:
        """Make room for surfaces in ``leaves`` [N, 3]; new feature vectors start at random.

        Leaves are int64 coordinates in ``[0, 2**depth)``, as evidence voxels.
        """
        if not self._has_features:
            return
        added = self._growing.grow(leaves)
        self._corners = None
        size = (added, self.settings.feature_size)
        self.features.append(self._normal(*size) * self.settings.feature_std)

    def sdf(self, points: Tensor) -> Tensor:
        """Signed distance [N] in metres; differentiable in the points."""
        weights = [part.values[0] for part in self.mlp]
        return (
            self._decode(points, self._interpolate(points), weights) * self.settings.logit_scale_m
        )

    def sdf_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] and its gradient [N, 3]."""
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            sdf = self.sdf(points)
            (gradient,) = torch.autograd.grad(sdf.sum(), points)
        return sdf.detach(), gradient

    def train(self, points: Tensor, labels: Tensor, rate: float, betas: Betas) -> Tensor:
        """One optimiser step on ``points`` [N, 3] with signed distances ``labels`` [N] (metres).

        The loss is the cross entropy between the two distances squashed by a sigmoid
        (3QFP, equation 5). Returns it as it was before the step.
        """
        corners = self._around(points) if self._has_features else None
        encoded = self._gather(corners) if corners is not None else None
        if encoded is not None:
            encoded.requires_grad_()
        weights = [part.values[0].detach().requires_grad_() for part in self.mlp]
        with torch.enable_grad():
            logits = self._decode(points, encoded, weights)
            target = torch.sigmoid(labels / self.settings.logit_scale_m)
            loss = F.binary_cross_entropy_with_logits(logits, target)
            torch.autograd.backward(loss)
        for part, weight in zip(self.mlp, weights, strict=True):
            assert weight.grad is not None
            part.step(
                torch.zeros(1, dtype=torch.int64, device=self.device),
                weight.grad[None],
                rate,
                betas,
            )
        if corners is not None and encoded is not None and encoded.grad is not None:
            self._step_features(corners, encoded.grad, rate, betas)
        return loss.detach()

    def restore(self, plane: int, h: int, codes: NDArray[np.int64], features: Tensor) -> None:
        """Add the vertices ``codes`` [V] of one level with their ``features`` [V, d]."""
        self._growing.restore(plane, h, codes)
        self.features.append(features)
        self._corners = None

    def copy(self) -> "Field":
        """A copy for reading, which later training does not change."""
        twin = Field.__new__(Field)
        twin.settings, twin.device = self.settings, self.device
        twin._generator = self._generator
        twin.tree = self._growing.freeze()
        twin._corners = None
        twin.features = self.features.snapshot()
        twin.frequencies = self.frequencies
        twin.mlp = [part.snapshot() for part in self.mlp]
        return twin

    @property
    def _has_features(self) -> bool:
        return self.settings.encoding != "fourier"

    def _around(self, points: Tensor) -> Corners:
        if self._corners is None:
            self._corners = CornerIndex(self.tree, self.settings, self.device)
        return self._corners.around(points)

    def _interpolate(self, points: Tensor) -> Tensor | None:
        return self._gather(self._around(points)) if self._has_features else None

    def _gather(self, corners: Corners) -> Tensor:
        """Interpolated features [N, H * d], summed over the planes."""
        count, levels, around = corners.rows.shape
        summed = F.embedding_bag(
            corners.rows.view(-1, around),
            self.features.values,
            mode="sum",
            per_sample_weights=corners.weights.reshape(-1, around),
        )
        return summed.view(count, -1)

    def _decode(self, points: Tensor, encoded: Tensor | None, weights: list[Tensor]) -> Tensor:
        parts = [] if encoded is None else [encoded]
        if self.settings.encoding != "features":
            parts.append(self._fourier(points))
        w1, b1, w2, b2, w3, b3 = weights
        hidden = F.relu(torch.addmm(b1, torch.cat(parts, 1), w1))
        hidden = F.relu(torch.addmm(b2, hidden, w2))
        return torch.addmm(b3, hidden, w3)[:, 0]

    def _fourier(self, points: Tensor) -> Tensor:
        """Fourier features [N, 6m] of coordinates normalised to [-1, 1] over the cube."""
        normalised = points / (self.settings.region_side_m / 2)
        angles = 2 * math.pi * normalised[:, :, None] * self.frequencies
        angles = angles.reshape(len(points), -1)
        return torch.cat([angles.sin(), angles.cos()], 1)

    def _step_features(self, corners: Corners, gradient: Tensor, rate: float, betas: Betas) -> None:
        size = self.settings.feature_size
        rows = corners.rows.view(-1)
        shares = gradient.view(-1, 1, size) * corners.weights.view(-1, corners.rows.shape[2], 1)
        total = torch.zeros_like(self.features.values)
        total.index_add_(0, rows, shares.view(-1, size))
        touched = torch.zeros(len(total), dtype=torch.bool, device=self.device)
        touched[rows] = True
        touched[0] = False  # absent vertices stay zero
        if self.device.type == "cpu":
            chosen = touched.nonzero()[:, 0]
            self.features.step(chosen, total[chosen], rate, betas)
        else:
            self.features.step_where(touched, total, rate, betas)

    def _normal(self, *size: int) -> Tensor:
        return torch.randn(size, generator=self._generator, device=self.device)

    def _new_mlp(self) -> list[Tensor]:
        """Weights [in, out] and biases, uniform in +-1/sqrt(in) as torch.nn.Linear's."""
        hidden = self.settings.hidden
        parts = []
        for inputs, outputs in ((self.settings.input_size, hidden), (hidden, hidden), (hidden, 1)):
            bound = 1 / math.sqrt(inputs)
            for size in ((inputs, outputs), (outputs,)):
                parts.append(
                    (torch.rand(size, generator=self._generator, device=self.device) * 2 - 1)
                    * bound
                )
        return parts
