"""Ray intervals: what rays teach of the signed distance, and training samples drawn along them.

A ray tells the signed distance all along itself: nothing at its end point, more before it, less
behind it. The published label is the distance to the end point along the ray, which is too large
where the ray meets the surface at an angle. Where the surface's normal is known, the label here is
the distance to its plane, so it changes by the cosine of the angle of incidence for each metre.

A table of ray intervals [N, COLUMNS] is float32, metres, relative to the region's centre. Every
draw (3QFP, section III-C) makes new samples: an interval that is trained on again teaches other
points of its ray.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_map.compiled.field.feature_rows import prefetch_row
from triquad_map.compiled.field.quadtree import morton_code
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.team import Team

from triquad_server.engine.live_field import Batch
from triquad_server.intake.rays import ScanRays
from triquad_server.settings import ScanSettings

END = 0  # and the two columns after it: the end point
DIRECTION = 3  # and the two columns after it: away from the sensor; 0 for a single sample
LABEL = 6  # signed distance at the end point
SLOPE = 7  # by so much the signed distance falls per metre behind it
FREE_FROM = 8  # free space is sampled from here, metres behind the end point: mostly negative
FREE_TO = 9  # to here
COLUMNS = 10

_MIN_COSINE = 0.05

_CELLS = 128
"""Cells from the centre of the cube to its face, by which samples are put in order."""

_AHEAD = 16  # intervals that are brought into the cache before their turn


@kernel()
def _set_direction(direction: Doubles, origin: Doubles, end: Doubles) -> float:
    """Set the unit vector [3] from ``origin`` to ``end``; returns how far it is."""
    squared = 0.0
    for axis in range(3):
        direction[axis] = end[axis] - origin[axis]
        squared += direction[axis] * direction[axis]
    reach_m: float = np.sqrt(squared)
    if reach_m > 0:
        for axis in range(3):
            direction[axis] /= reach_m
    return reach_m


@kernel()
def _clipped(
    end: Doubles, direction: Doubles, half_side_m: float, first: float, last: float
) -> tuple[float, float]:
    """The part of an interval of a ray that lies in the cube; none where it begins after its end.

    It is in metres behind the end point [3]. The cube is centred at the origin.
    """
    for axis in range(3):
        if direction[axis] != 0:  # stay between both faces of the cube on this axis
            a = (-half_side_m - end[axis]) / direction[axis]
            b = (half_side_m - end[axis]) / direction[axis]
            first, last = max(first, min(a, b)), min(last, max(a, b))
        elif abs(end[axis]) >= half_side_m:
            first, last = 1.0, 0.0
    return first, last


@kernel()
def _fill(
    origin: Doubles,
    ends: Doubles,
    normals: Doubles,
    half_side_m: float,
    free_from: float,
    behind_m: float,
    table: Floats,
) -> int:
    """Fill the table with the intervals of rays that pass the cube; returns how many."""
    count = 0
    direction = np.empty(3)
    for i in range(len(ends)):
        reach_m = _set_direction(direction, origin, ends[i])
        if reach_m == 0:
            continue
        nearest = (free_from - 1) * reach_m
        first, last = _clipped(ends[i], direction, half_side_m, nearest, behind_m)
        if not first <= last:
            continue
        row = table[count]
        cosine = 0.0
        for axis in range(3):
            cosine += direction[axis] * normals[i, axis]
            row[END + axis] = ends[i, axis]
            row[DIRECTION + axis] = direction[axis]
        row[LABEL] = 0
        row[SLOPE] = 1.0 if np.isnan(cosine) else max(abs(cosine), _MIN_COSINE)
        row[FREE_FROM] = first
        row[FREE_TO] = last
        count += 1
    return count


def ray_intervals(
    rays: ScanRays, normals: Doubles, centre: Doubles, half_side_m: float, settings: ScanSettings
) -> Floats:
    """Intervals of the rays that pass a region's cube, cut off at its faces.

    Args:
        rays: N rays.
        normals: [N, 3] unit normals at the end points, NaN where unknown.
        centre: [3] of the region, map frame.
        half_side_m: half the side of its cube.
        settings: where free space is sampled.
    """
    table = np.empty((len(rays.ends), COLUMNS), np.float32)
    count = _fill(
        rays.origin - centre,
        rays.ends - centre,
        normals,
        half_side_m,
        settings.free_from,
        settings.behind_m,
        table,
    )
    return table[:count]


def sample_intervals(points: Floats, labels: NDArray[np.floating]) -> Floats:
    """Intervals without length that teach the signed distances ``labels`` [N] at points [N, 3]."""
    table = np.zeros((len(points), COLUMNS), np.float32)
    table[:, END : END + 3] = points
    table[:, LABEL] = labels
    return table


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
        ends + offsets[:, None] * directions, intervals[:, LABEL] - offsets * intervals[:, SLOPE]
    )


@kernel()
def _draw(
    intervals: Floats,
    chosen: Longs,
    placement: Placement,
    kinds: Floats,
    places: Floats,
    near: Floats,
    samples: Floats,
    cells: Longs,
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
def _in_order(samples: Floats, cells: Longs) -> tuple[Floats, Floats]:
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
    intervals: Floats, chosen: Longs, placement: Placement, rng: np.random.Generator, team: Team
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
