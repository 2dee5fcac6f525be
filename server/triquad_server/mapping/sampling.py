"""Training samples drawn along ray intervals (3QFP, section III-C).

Every draw makes new ones: an interval that is trained on again teaches other points of its ray.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_map.compiled.field.feature_rows import prefetch_row
from triquad_map.compiled.field.quadtree import morton_code
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.team import Team

from triquad_server.engine.batch import Batch
from triquad_server.mapping.ray_intervals import DIRECTION, END, FREE_FROM, FREE_TO, LABEL, SLOPE

Floats = NDArray[np.float32]

_CELLS = 128
"""Cells from the centre of the cube to its face, by which samples are put in order."""

_AHEAD = 16  # intervals that are brought into the cache before their turn


class Placement(NamedTuple):
    """Where on their intervals samples lie."""

    surface_share: float  # of the samples that lie around the end points
    spread_m: float  # standard deviation of those
    truncation_m: float  # and how far off they lie at most
    half_side_m: float  # of the region's cube: samples lie inside


def draw_samples(intervals: Tensor, placement: Placement, generator: torch.Generator) -> Batch:
    """One sample on each of the ``intervals`` [B, COLUMNS], on their device."""
    kinds, places = torch.rand((2, len(intervals)), generator=generator, device=intervals.device)
    near = torch.randn(len(intervals), generator=generator, device=intervals.device)
    near = (near * placement.spread_m).clamp(-placement.truncation_m, placement.truncation_m)
    ends, directions = intervals[:, END : END + 3], intervals[:, DIRECTION : DIRECTION + 3]
    first, last = intervals[:, FREE_FROM], intervals[:, FREE_TO]
    outside = ((ends + near[:, None] * directions).abs() >= placement.half_side_m).any(dim=1)
    free = first + places * (last - first)
    offsets = torch.where((kinds < placement.surface_share) & ~outside, near, free)
    return Batch(
        ends + offsets[:, None] * directions,
        intervals[:, LABEL] - offsets * intervals[:, SLOPE],
    )


@kernel()
def _draw(
    intervals: Floats,
    chosen: NDArray[np.int64],
    placement: Placement,
    kinds: Floats,
    places: Floats,
    near: Floats,
    samples: Floats,
    cells: NDArray[np.int64],
) -> None:
    """Fill in the samples [B, 4], points and labels, and the cells [B] that hold them."""
    per_m = _CELLS / placement.half_side_m
    for i in range(len(chosen)):
        prefetch_row(intervals, chosen[min(i + _AHEAD, len(chosen) - 1)])
        row = intervals[chosen[i]]
        offset = near[i] * placement.spread_m
        offset = min(max(offset, -placement.truncation_m), placement.truncation_m)
        outside = False
        for axis in range(3):
            place = row[END + axis] + offset * row[DIRECTION + axis]
            outside = outside or abs(place) >= placement.half_side_m
        if outside or kinds[i] >= placement.surface_share:
            offset = row[FREE_FROM] + places[i] * (row[FREE_TO] - row[FREE_FROM])
        for axis in range(3):
            samples[i, axis] = row[END + axis] + offset * row[DIRECTION + axis]
        samples[i, 3] = row[LABEL] - offset * row[SLOPE]
        u = min(max(int(samples[i, 0] * per_m + _CELLS), 0), 2 * _CELLS - 1)
        v = min(max(int(samples[i, 1] * per_m + _CELLS), 0), 2 * _CELLS - 1)
        cells[i] = morton_code(u, v)


@kernel()
def _in_order(samples: Floats, cells: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Points [B, 3] and labels [B] in the order of their cells (a counting sort)."""
    starts = np.zeros((2 * _CELLS) ** 2 + 1, np.int32)
    for cell in cells:
        starts[cell + 1] += 1
    for i in range(1, len(starts)):
        starts[i] += starts[i - 1]
    points, labels = np.empty((len(cells), 3), np.float32), np.empty(len(cells), np.float32)
    for i in range(len(cells)):
        place = starts[cells[i]]
        starts[cells[i]] += 1
        for axis in range(3):
            points[place, axis] = samples[i, axis]
        labels[place] = samples[i, 3]
    return points, labels


def draw_ordered_samples(
    intervals: Floats,
    chosen: NDArray[np.int64],
    placement: Placement,
    rng: np.random.Generator,
    team: Team,
) -> Batch:
    """As :func:`draw_samples` for the intervals ``chosen`` [B], in compiled code.

    Neighbours in space follow each other, and find in the cache what the last one fetched.
    """
    count = len(chosen)
    samples = np.empty((count, 4), np.float32)
    cells = np.empty(count, np.int64)
    kinds, places = rng.random((2, count), np.float32)
    near = rng.standard_normal(count, np.float32)

    def work(first: int, last: int) -> None:
        part = slice(first, last)
        _draw(
            intervals,
            chosen[part],
            placement,
            kinds[part],
            places[part],
            near[part],
            samples[part],
            cells[part],
        )

    team.split(count, work)
    points, labels = _in_order(samples, cells)
    return Batch(torch.from_numpy(points), torch.from_numpy(labels))
