"""Rays that are kept as tensors, and samples drawn along them: on any device, and the reference."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from triquad_format.records.arrays import Floats, Longs

from triquad_server.engine.live_field import Batch
from triquad_server.mapping.ray_table import COLUMNS, END, VALUE, Placement, RayTable


class TensorTable(NamedTuple):
    """A :class:`RayTable` on the device that trains."""

    rows: Tensor
    origin_of: Tensor  # int64
    origins: Tensor

    @classmethod
    def of(cls, table: RayTable, device: str) -> "TensorTable":
        """A copy of a table."""
        rows, origin_of, origins = (torch.tensor(part, device=device) for part in table)
        return cls(rows, origin_of.long(), origins)


class DeviceRays:
    """A copy of a replay pool's rays on the device that trains, from which samples are drawn."""

    def __init__(self, device: str, placement: Placement, seed: int) -> None:
        self._device = device
        self._placement = placement
        self._generator = torch.Generator(device).manual_seed(seed)
        nothing = np.zeros(0, np.int32)
        empty = RayTable(np.zeros((0, COLUMNS), np.float32), nothing, np.zeros((0, 3), np.float32))
        self._table = TensorTable.of(empty, device)

    def replace(self, table: RayTable) -> None:
        """The pool has other rays now, or more room."""
        self._table = TensorTable.of(table, self._device)

    def put(self, places: Longs, new: RayTable) -> None:
        """The rays at ``places`` [N] are these now, and all origins those that come with them."""
        added, changed = TensorTable.of(new, self._device), self._places(places)
        self._table.rows[changed] = added.rows
        self._table.origin_of[changed] = added.origin_of
        self._table = self._table._replace(origins=added.origins)

    def set_values(self, places: Longs, values: Floats) -> None:
        """The rays at ``places`` [N] have these ``values`` [N] now."""
        self._table.rows[self._places(places), VALUE] = torch.tensor(values, device=self._device)

    def draw(self, places: Longs) -> Batch:
        """One sample on each of the rays at ``places`` [B]."""
        return draw_samples(self._table, self._places(places), self._placement, self._generator)

    def _places(self, places: Longs) -> Tensor:
        return torch.tensor(places, device=self._device)


def draw_samples(
    table: TensorTable, chosen: Tensor, placement: Placement, generator: torch.Generator
) -> Batch:
    """One sample on each of the rays ``chosen`` [B], on their device."""
    rows, origin_of = table.rows[chosen], table.origin_of[chosen]
    ends, values = rows[:, END : END + 3], rows[:, VALUE]
    count, device = len(chosen), rows.device
    kinds, places = torch.rand((2, count), generator=generator, device=device)
    near = torch.randn(count, generator=generator, device=device)
    near = (near * placement.spread_m).clamp(-placement.truncation_m, placement.truncation_m)
    is_ray = origin_of >= 0
    origins = ends if len(table.origins) == 0 else table.origins[origin_of.clamp(min=0)]
    ways = torch.where(is_ray[:, None], ends - origins, torch.zeros_like(ends))
    reach_m = ways.norm(dim=1)
    directions = ways / reach_m.clamp(min=1e-12)[:, None]
    half_side_m = placement.half_side_m
    outside = ((ends + near[:, None] * directions).abs() >= half_side_m).any(dim=1)
    faces = torch.stack([(side - ends) / directions for side in (-half_side_m, half_side_m)])
    unbounded = torch.tensor([-torch.inf, torch.inf], device=device)[:, None, None]
    faces = torch.where(directions == 0, unbounded, faces)  # there they are infinite or NaN
    begin = (placement.free_from - 1) * reach_m
    first = torch.maximum(begin, faces.amin(0).amax(1))
    last = faces.amax(0).amin(1).clamp(max=placement.behind_m)
    free = first + places * (last - first)
    # Of a ray that leaves the cube, free space is as much less.
    inside = ((last - first) / (placement.behind_m - begin).clamp(min=1e-12)).clamp(0, 1)
    surface_share = placement.surface_share
    kinds = kinds * (surface_share + (1 - surface_share) * inside)
    offsets = torch.where((kinds < surface_share) & ~outside, near, free)
    labels = torch.where(is_ray, -offsets * values.abs(), values)
    return Batch(ends + torch.where(is_ray, offsets, 0.0)[:, None] * directions, labels)
