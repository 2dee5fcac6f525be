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
from torch import Tensor
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES
from triquad_map.compiled.voxel_index import home_slot, longest_probe, morton_code
from triquad_map.field.quadtree import (
    PLANE_BITS,
    FrozenQuadtree,
    LiveQuadtree,
)
from triquad_map.surface import FieldValues

from triquad_server.engine.live_field import LiveField
from triquad_server.engine.memory import Array, FieldNumbers, Memory

_CHUNK = 131_072  # points that tensors are made for at a time


def tensors_of(field: LiveField) -> FieldNumbers:
    """Return the numbers of a field as they are now, as tensors; they share memory with arrays."""
    features, mlp, frequencies = field.numbers
    tensor = torch.as_tensor
    return FieldNumbers(tensor(features), tuple(map(tensor, mlp)), tensor(frequencies))


@dataclass(frozen=True)
class Corners:
    """The vertices around N points, on all planes, for each of H levels (coarsest first)."""

    rows: Tensor  # [N, H, 12] int32 rows of the feature table; 0 stands for an absent vertex
    weights: Tensor  # [N, H, 12] bilinear weights; differentiable in the points


class CornerIndex:
    """Finds a tree's blocks in tensors on a device; they do not grow when the tree does."""

    def __init__(
        self, tree: LiveQuadtree | FrozenQuadtree, settings: FieldSettings, device: torch.device
    ) -> None:
        self._settings = settings
        blocks = tree.vertices.blocks
        self._keys = torch.as_tensor(blocks.keys, device=device)
        self._numbers = torch.as_tensor(blocks.rows, device=device)
        self._rows = torch.as_tensor(tree.vertices.rows, device=device)
        self._probes = longest_probe(blocks)
        self._starts = tree.shape.starts.tolist()
        sides = [(1 << h) + 1 for h in range(settings.feature_levels)]
        self._offsets = torch.tensor([[0, side, 1, side + 1] for side in sides], device=device)

    def around(self, points: Tensor) -> Corners:
        """Return vertices around ``points`` [N, 3] (metres from the centre) and their weights."""
        levels = self._settings.feature_levels
        leaf = points / self._settings.leaf_m + (1 << (self._settings.depth - 1))
        blocks = leaf / (1 << (levels - 1))
        rows, weights = [], []
        for plane, (first, second) in enumerate(AXES):
            uv = torch.stack([blocks[:, first], blocks[:, second]], 1)
            block = uv.detach().floor()
            number = self._find(plane, block.to(torch.int64))
            plane_rows = self._rows[number]
            local = uv - block
            for h in range(levels):
                scaled = local * (1 << h)
                cell = scaled.detach().floor()
                t = scaled - cell
                side = (1 << h) + 1
                corner = self._starts[h] + (cell[:, 0] * side + cell[:, 1]).to(torch.int64)
                rows.append(plane_rows.gather(1, corner[:, None] + self._offsets[h]))
                weights.append(_bilinear(t))
        return Corners(self._by_level(rows), self._by_level(weights))

    def _find(self, plane: int, block: Tensor) -> Tensor:
        """Return the numbers of blocks [N, 2]; 0 where there is none."""
        side = 1 << self._settings.levels[0]
        inside = ((block >= 0) & (block < side)).all(dim=1)
        block = block.clamp(0, side - 1)
        keys = morton_code(block[:, 0], block[:, 1]) + (plane << PLANE_BITS)
        mask = len(self._keys) - 1
        slots = home_slot(keys, mask)
        numbers = torch.zeros_like(self._numbers[slots])
        for _ in range(self._probes):
            numbers = torch.where(self._keys[slots] == keys, self._numbers[slots], numbers)
            slots = (slots + 1) & mask
        return numbers * inside

    def _by_level(self, parts: list[Tensor]) -> Tensor:
        """Return parts [N, 4], plane by plane, as [N, H, 12]."""
        levels = self._settings.feature_levels
        stacked = torch.stack(parts, 1).view(-1, len(AXES), levels, 4)
        return stacked.transpose(1, 2).reshape(-1, levels, 12)


def _bilinear(t: Tensor) -> Tensor:
    """Return weights [N, 4] of corners (0, 0), (1, 0), (0, 1), (1, 1) at fractions ``t`` [N, 2]."""
    a, b = t[:, 0], t[:, 1]
    return torch.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], 1)


class TensorField:
    """Evaluates the field as it is while its tree does not grow; it follows changes of its tensors.

    Points are float32 [N, 3], metres from the region's centre.
    """

    def __init__(
        self, settings: FieldSettings, tree: LiveQuadtree | FrozenQuadtree, tensors: FieldNumbers
    ) -> None:
        self.settings = settings
        self.tree = tree
        self.tensors = tensors
        self.device = tensors.features.device
        self._corners = (
            CornerIndex(tree, settings, self.device) if settings.encoding != "fourier" else None
        )

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """Evaluate the field at points [N, 3]."""
        parts = [
            self._evaluate(points[start : start + _CHUNK], gradient)
            for start in range(0, max(1, len(points)), _CHUNK)
        ]
        return FieldValues(
            np.concatenate([part.sdf for part in parts]),
            np.concatenate([part.gradient for part in parts]),
        )

    def sdf(self, points: Tensor) -> Tensor:
        """Return the signed distance [N] in metres; differentiable in the points."""
        corners = self.around(points)
        encoded = None if corners is None else self.gather(corners)
        return self.logits(points, encoded, self.tensors.mlp) * self.settings.logit_scale_m

    def sdf_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the signed distance [N] and its gradient [N, 3]."""
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            sdf = self.sdf(points)
            (gradient,) = torch.autograd.grad(sdf.sum(), points)
        return sdf.detach(), gradient

    def around(self, points: Tensor) -> Corners | None:
        """Return the vertices around points; ``None`` where the field has no features."""
        return None if self._corners is None else self._corners.around(points)

    def gather(self, corners: Corners) -> Tensor:
        """Return the interpolated features [N, H * d], summed over the planes."""
        count, levels, around = corners.rows.shape
        features = self.tensors.features
        summed = F.embedding_bag(
            corners.rows.view(-1, around),
            features,
            mode="sum",
            per_sample_weights=corners.weights.reshape(-1, around),
        )
        return summed.view(count, levels * features.shape[1])

    def logits(self, points: Tensor, encoded: Tensor | None, mlp: tuple[Tensor, ...]) -> Tensor:
        """Return the output [N] of ``mlp`` for points and their interpolated features."""
        parts = [] if encoded is None else [encoded]
        if self.settings.encoding != "features":
            parts.append(self._fourier(points))
        w1, b1, w2, b2, w3, b3 = mlp
        hidden = F.relu(torch.addmm(b1, torch.cat(parts, 1), w1))
        hidden = F.relu(torch.addmm(b2, hidden, w2))
        return torch.addmm(b3, hidden, w3)[:, 0]

    def _fourier(self, points: Tensor) -> Tensor:
        """Return Fourier features [N, 6m] of coordinates normalised to [-1, 1] over the cube."""
        normalised = points / (self.settings.region_side_m / 2)
        angles = 2 * math.pi * normalised[:, :, None] * self.tensors.frequencies
        angles = angles.reshape(len(points), 3 * len(self.tensors.frequencies))
        return torch.cat([angles.sin(), angles.cos()], 1)

    def _evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        tensor = torch.from_numpy(points).to(self.device)
        if gradient:
            value, slope = self.sdf_and_gradient(tensor)
            return FieldValues(value.cpu().numpy(), slope.cpu().numpy())
        with torch.no_grad():
            value = self.sdf(tensor)
        return FieldValues(value.cpu().numpy(), np.zeros((0, 3), np.float32))


class TensorMemory(Memory):
    """Keeps numbers in tensors on one device."""

    def __init__(self, device: str) -> None:
        self.device = device

    def put(self, array: Array) -> Tensor:
        """Return a copy of an array."""
        return torch.tensor(array, device=self.device)

    def room(self, count: int, like: Tensor) -> Tensor:
        """Return ``count`` rows shaped as those of ``like``, not initialised."""
        return like.new_empty((count, *like.shape[1:]))

    def array(self, rows: Tensor) -> Array:
        """Return rows as an array; from another device, a copy, for which all work there ends."""
        array: Array = rows.cpu().numpy()
        return array
