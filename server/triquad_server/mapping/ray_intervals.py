"""Ray intervals: what rays teach of the signed distance.

A ray tells the signed distance all along itself: nothing at its end point, more before it, less
behind it. The published label is the distance to the end point along the ray, which is too large
where the ray meets the surface at an angle. Where the surface's normal is known, the label here is
the distance to its plane, so it changes by the cosine of the angle of incidence for each metre.

A table of ray intervals [N, COLUMNS] is float32, metres, relative to the region's centre.
"""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats
from triquad_map.compiled.kernel import kernel

from triquad_server.intake.scan import ScanRays
from triquad_server.settings import ScanSettings

END = 0  # and the two columns after it: the end point
DIRECTION = 3  # and the two columns after it: away from the sensor; 0 for a single sample
LABEL = 6  # signed distance at the end point
SLOPE = 7  # by so much the signed distance falls per metre behind it
FREE_FROM = 8  # free space is sampled from here, metres behind the end point: mostly negative
FREE_TO = 9  # to here
COLUMNS = 10

_MIN_COSINE = 0.05


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
