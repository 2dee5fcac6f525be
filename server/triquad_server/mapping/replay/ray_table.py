"""Kept rays, what they teach of the signed distance, and samples drawn along them.

A ray gives the signed distance all along itself: zero at its end point, more before it, less
behind it. The published label is the distance to the end point along the ray, which is too large
where the ray meets the surface at an angle. Where the surface's normal is known, the label here is
the distance to its plane, so it changes by the cosine of the angle of incidence for each metre.
Near edges and on small things the points around give no normal: there the label is the distance
along the ray at first, and by the gradient of the field itself once that knows the surface.

All is in metres, relative to the region's centre. Every draw (3QFP, section III-C) makes new
samples: a ray that is trained on again teaches other points of itself.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints, Longs
from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.lanes import prefetch_row
from triquad_map.compiled.team import Team
from triquad_map.compiled.voxel_index import morton_code

from triquad_server.engine.live_field import Batch
from triquad_server.intake.rays import ScanRays

END = 0  # and the two columns after it: the end point
VALUE = 3
COLUMNS = 4

NO_ORIGIN = -1

AnyFloats = NDArray[np.floating]

LEAST_SLOPE = 0.05

_CELLS = 128
"""The number of cells from the centre of the cube to its face, used to sort samples."""

_AHEAD = 16  # rays that are fetched into the cache in advance


class RayTable(NamedTuple):
    """A table of rays, and of single samples, which have no origin."""

    rows: Floats
    """[N, COLUMNS] The end point, and by how much the signed distance falls for each metre of the
    ray, negated where no normal gave it; of a sample, the point and its signed distance."""

    origin_of: Ints  # [N] row of a ray's origin; NO_ORIGIN of a sample
    origins: Floats  # [K, 3] where the sensor was

    def __len__(self) -> int:
        return len(self.rows)

    def of(self, chosen: Bools) -> "RayTable":
        """Return the ``chosen`` [N] rays, with all origins."""
        places = np.flatnonzero(chosen)  # by a mask, rows are copied a tenth as fast
        return RayTable(self.rows.take(places, axis=0), self.origin_of[places], self.origins)

    @property
    def ends(self) -> Floats:
        """The end points [R, 3] of the rays, without the single samples."""
        return self.rows[self.origin_of >= 0, END : END + 3]


class Placement(NamedTuple):
    """The placement of samples on their rays."""

    surface_share: float  # share of the samples that lie around the end points
    spread_m: float  # standard deviation of those
    behind_m: float  # the others lie all along the ray, to this distance behind its end
    half_side_m: float  # of the region's cube: samples lie inside


@inner_kernel()
def _set_direction(direction: Doubles, origin: AnyFloats, end: AnyFloats) -> float:
    """Set the unit vector [3] from ``origin`` to ``end``; return their distance."""
    squared = 0.0
    for axis in range(3):
        direction[axis] = end[axis] - origin[axis]
        squared += direction[axis] * direction[axis]
    reach_m: float = np.sqrt(squared)
    if reach_m > 0:
        for axis in range(3):
            direction[axis] /= reach_m
    return reach_m


@inner_kernel()
def _clipped(
    end: AnyFloats, direction: Doubles, half_side_m: float, first: float, last: float
) -> tuple[float, float]:
    """Return the part of a ray's interval in the cube; if there is none, it begins after its end.

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


@inner_kernel()
def _free_part(
    end: AnyFloats, direction: Doubles, reach_m: float, placement: Placement
) -> tuple[float, float, float]:
    """Return where the free space of a ray in the cube begins and ends, metres behind the end point
    [3], and its share of that of the whole ray."""
    first, last = -reach_m, placement.behind_m
    whole = last - first
    leaves_cube = False
    for axis in range(3):
        one, other = end[axis] + first * direction[axis], end[axis] + last * direction[axis]
        leaves_cube = leaves_cube or max(abs(one), abs(other)) >= placement.half_side_m
    if not leaves_cube:
        return first, last, 1.0
    first, last = _clipped(end, direction, placement.half_side_m, first, last)
    return first, last, max(last - first, 0.0) / whole if whole > 0 else 0.0


@kernel()
def _fill(
    origin: Doubles,
    ends: Doubles,
    normals: Doubles,
    used: Bools,
    placement: Placement,
    chances: Doubles,
    rows: Floats,
) -> int:
    """Fill the rows with rays that are used and pass the cube; return how many."""
    count = 0
    direction = np.empty(3)
    for i in range(len(ends)):
        reach_m = _set_direction(direction, origin, ends[i])
        if reach_m == 0 or not used[i]:
            continue
        _, _, free = _free_part(ends[i], direction, reach_m, placement)
        ends_inside = True
        for axis in range(3):
            ends_inside = ends_inside and abs(ends[i, axis]) < placement.half_side_m
        outside = (1 - placement.surface_share) * (1 - free)  # share of the ray's samples
        outside += 0.0 if ends_inside else placement.surface_share
        if chances[i] >= 1 - outside:
            continue
        cosine = 0.0
        for axis in range(3):
            cosine += direction[axis] * normals[i, axis]
            rows[count, END + axis] = ends[i, axis]
        rows[count, VALUE] = -1.0 if np.isnan(cosine) else max(abs(cosine), LEAST_SLOPE)
        count += 1
    return count


def rays_through(
    rays: ScanRays,
    normals: Doubles,
    used: Bools,
    centre: Doubles,
    placement: Placement,
    rng: np.random.Generator,
) -> RayTable:
    """Return the rays in a region's cube; of those partly there, a share as large as their part.

    So all regions together draw from their rays what a single one would draw.

    Args:
        rays: N rays, map frame.
        normals: [N, 3] unit normals at the end points, NaN where unknown.
        used: [N] those among which they are.
        centre: [3] of the region, map frame.
        placement: where on them samples are to lie.
        rng: chooses among rays that are partly in the cube.
    """
    rows = np.empty((len(rays.ends), COLUMNS), np.float32)
    origin = rays.origin - centre
    chances = rng.random(len(rows))
    rows = rows[: _fill(origin, rays.ends - centre, normals, used, placement, chances, rows)]
    return RayTable(rows, np.zeros(len(rows), np.int32), origin[None].astype(np.float32))


def samples_alone(points: Floats, labels: NDArray[np.floating]) -> RayTable:
    """Return samples that teach the signed distances ``labels`` [N] at points [N, 3]."""
    rows = np.column_stack([points, labels]).astype(np.float32)
    no_origins = np.zeros((0, 3), np.float32)
    return RayTable(rows, np.full(len(rows), NO_ORIGIN, np.int32), no_origins)


@kernel()
def _draw(
    table: RayTable,
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
    direction = np.zeros(3)
    for i in range(len(chosen)):
        prefetch_row(table.rows, chosen[min(i + _AHEAD, len(chosen) - 1)])
        row, origin = table.rows[chosen[i]], table.origin_of[chosen[i]]
        offset = 0.0
        if origin >= 0:
            reach_m = _set_direction(direction, table.origins[origin], row)
            offset = near[i] * placement.spread_m
            outside = False
            for axis in range(3):
                place = row[END + axis] + offset * direction[axis]
                outside = outside or abs(place) >= placement.half_side_m
            if outside or kinds[i] >= placement.surface_share:
                first, last, free = _free_part(row, direction, reach_m, placement)
                # The samples on free space of a ray that leaves the cube are fewer in proportion.
                share = placement.surface_share + (1 - placement.surface_share) * free
                if outside or kinds[i] * share >= placement.surface_share:
                    offset = first + places[i] * (last - first)
        for axis in range(3):
            samples[i, axis] = row[END + axis] + offset * direction[axis]
        samples[i, 3] = -offset * abs(row[VALUE]) if origin >= 0 else row[VALUE]
        u = min(max(int(samples[i, 0] * per_m + _CELLS), 0), 2 * _CELLS - 1)
        v = min(max(int(samples[i, 1] * per_m + _CELLS), 0), 2 * _CELLS - 1)
        cells[i] = morton_code(u, v)


@kernel()
def _in_order(samples: Floats, cells: Longs) -> tuple[Floats, Floats]:
    """Return points [B, 3] and labels [B] in the order of their cells (a counting sort)."""
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
    table: RayTable, chosen: Longs, placement: Placement, rng: np.random.Generator, team: Team
) -> Batch:
    """Draw one sample on each of the rays ``chosen`` [B].

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
            table,
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
    return Batch(points, labels)
