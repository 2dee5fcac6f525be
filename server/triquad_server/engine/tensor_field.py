"""The field of one region on tensors: differentiable, on any device, and the reference.

3QFP, section III: the feature vectors of the vertices around a point are interpolated, summed over
the three planes and concatenated over the levels; Gaussian Fourier features of the coordinates
are appended; the MLP turns both into a logit, which is the signed distance in units of
``logit_scale_m``. Positive is free space.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.field.field import FieldArrays
from triquad_map.compiled.field.quadtree import FrozenQuadtree, LiveQuadtree
from triquad_map.composition.region import FieldValues

from triquad_server.engine.corners import CornerIndex, Corners

_CHUNK = 131_072  # points that tensors are made for at a time


@dataclass(frozen=True)
class FieldTensors:
    """The numbers of a field, all on one device."""

    features: Tensor  # [rows, d] by the rows of the tree; row 0, of absent vertices, is zero
    mlp: tuple[Tensor, ...]  # weights [in, out] and bias [out] of each layer in turn
    frequencies: Tensor  # [m] of Fourier features, on coordinates normalised to [-1, 1]

    @property
    def arrays(self) -> FieldArrays:
        """The same numbers as arrays, which share memory with tensors on the CPU."""
        mlp = tuple(part.detach().cpu().numpy() for part in self.mlp)
        return FieldArrays(self.features.cpu().numpy(), mlp, self.frequencies.cpu().numpy())


class TensorField:
    """The field as it is while its tree does not grow; it follows changes of its tensors.

    Points are float32 [N, 3], metres from the region's centre.
    """

    def __init__(
        self,
        settings: FieldSettings,
        tree: LiveQuadtree | FrozenQuadtree,
        tensors: FieldTensors,
    ) -> None:
        self.settings = settings
        self.tree = tree
        self.tensors = tensors
        self.device = tensors.features.device
        self._corners = (
            CornerIndex(tree, settings, self.device) if settings.encoding != "fourier" else None
        )

    @property
    def arrays(self) -> FieldArrays:
        """The numbers of the field."""
        return self.tensors.arrays

    def evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        """The field at points [N, 3]."""
        parts = [
            self._evaluate(points[start : start + _CHUNK], gradient)
            for start in range(0, max(1, len(points)), _CHUNK)
        ]
        return FieldValues(
            np.concatenate([part.sdf for part in parts]),
            np.concatenate([part.gradient for part in parts]),
        )

    def sdf(self, points: Tensor) -> Tensor:
        """Signed distance [N] in metres; differentiable in the points."""
        corners = self.around(points)
        encoded = None if corners is None else self.gather(corners)
        return self.logits(points, encoded, self.tensors.mlp) * self.settings.logit_scale_m

    def sdf_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] and its gradient [N, 3]."""
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            sdf = self.sdf(points)
            (gradient,) = torch.autograd.grad(sdf.sum(), points)
        return sdf.detach(), gradient

    def around(self, points: Tensor) -> Corners | None:
        """The vertices around points; ``None`` where the field has no features."""
        return None if self._corners is None else self._corners.around(points)

    def gather(self, corners: Corners) -> Tensor:
        """Interpolated features [N, H * d], summed over the planes."""
        count, levels, around = corners.rows.shape
        summed = F.embedding_bag(
            corners.rows.view(-1, around),
            self.tensors.features,
            mode="sum",
            per_sample_weights=corners.weights.reshape(-1, around),
        )
        return summed.view(count, -1)

    def logits(self, points: Tensor, encoded: Tensor | None, mlp: tuple[Tensor, ...]) -> Tensor:
        """What ``mlp`` makes [N] of points and their interpolated features."""
        parts = [] if encoded is None else [encoded]
        if self.settings.encoding != "features":
            parts.append(self._fourier(points))
        w1, b1, w2, b2, w3, b3 = mlp
        hidden = F.relu(torch.addmm(b1, torch.cat(parts, 1), w1))
        hidden = F.relu(torch.addmm(b2, hidden, w2))
        return torch.addmm(b3, hidden, w3)[:, 0]

    def _fourier(self, points: Tensor) -> Tensor:
        """Fourier features [N, 6m] of coordinates normalised to [-1, 1] over the cube."""
        normalised = points / (self.settings.region_side_m / 2)
        angles = 2 * math.pi * normalised[:, :, None] * self.tensors.frequencies
        angles = angles.reshape(len(points), -1)
        return torch.cat([angles.sin(), angles.cos()], 1)

    def _evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        tensor = torch.from_numpy(points).to(self.device)
        if gradient:
            value, slope = self.sdf_and_gradient(tensor)
            return FieldValues(value.cpu().numpy(), slope.cpu().numpy())
        with torch.no_grad():
            value = self.sdf(tensor)
        return FieldValues(value.cpu().numpy(), np.zeros((0, 3), np.float32))
