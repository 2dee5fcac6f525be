"""The quadtrees' vertices around points, in tensors on any device."""

from dataclasses import dataclass

import torch
from torch import Tensor
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES
from triquad_map.compiled.field.quadtree import (
    PLANE_BITS,
    FrozenQuadtree,
    LiveQuadtree,
    morton_code,
)
from triquad_map.compiled.voxel_index import MULTIPLIER, longest_probe


@dataclass(frozen=True)
class Corners:
    """The vertices around N points, on all planes, for each of H levels (coarsest first)."""

    rows: Tensor  # [N, H, 12] int32 rows of the feature table; 0 stands for an absent vertex
    weights: Tensor  # [N, H, 12] bilinear weights; differentiable in the points


class CornerIndex:
    """A tree's blocks as tensors on a device; they do not grow when the tree does."""

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
        """Vertices around ``points`` [N, 3] (metres from the centre) and their weights."""
        levels = self._settings.feature_levels
        leaf = points / self._settings.leaf_m + (1 << (self._settings.depth - 1))
        rows = []
        weights = []
        for plane, (first, second) in enumerate(AXES):
            uv = torch.stack([leaf[:, first], leaf[:, second]], 1) / (
                1 << (levels - 1)
            )  # in blocks
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
        """Numbers of blocks [N, 2]; 0 where there is none."""
        side = 1 << self._settings.levels[0]
        inside = ((block >= 0) & (block < side)).all(dim=1)
        block = block.clamp(0, side - 1)
        keys = morton_code(block[:, 0], block[:, 1]) + (plane << PLANE_BITS)
        mask = len(self._keys) - 1
        slots = ((keys * MULTIPLIER) >> 32) & mask
        numbers = torch.zeros_like(self._numbers[slots])
        for _ in range(self._probes):
            numbers = torch.where(self._keys[slots] == keys, self._numbers[slots], numbers)
            slots = (slots + 1) & mask
        return numbers * inside

    def _by_level(self, parts: list[Tensor]) -> Tensor:
        """Parts [N, 4], plane by plane, as [N, H, 12]."""
        levels = self._settings.feature_levels
        stacked = torch.stack(parts, 1).view(-1, len(AXES), levels, 4)
        return stacked.transpose(1, 2).reshape(-1, levels, 12)


def _bilinear(t: Tensor) -> Tensor:
    """Weights [N, 4] of the vertices (0, 0), (1, 0), (0, 1), (1, 1) at fractions ``t`` [N, 2]."""
    a, b = t[:, 0], t[:, 1]
    return torch.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], 1)
