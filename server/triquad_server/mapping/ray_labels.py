"""Segments: what rays teach of the signed distance.

A ray tells the signed distance all along itself: nothing at its end point, more before it, less
behind it. The published label is the distance to the end point along the ray, which is too large
where the ray meets the surface at an angle. Where the surface's normal is known, the label here is
the distance to its plane, so it changes by the cosine of the angle of incidence for each metre.

A table of segments [N, COLUMNS] is float32, metres, relative to the region's centre.
"""

import numpy as np
from numpy.typing import NDArray
from triquad_map.compiled.kernel import kernel

from triquad_server.intake.scan import Rays
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
def _fill(
    origin: NDArray[np.float64],
    ends: NDArray[np.float64],
    normals: NDArray[np.float64],
    half_side: float,
    free_from: float,
    behind_m: float,
    table: NDArray[np.float32],
) -> int:
    """Fill the table with the segments that pass the cube; returns how many."""
    count = 0
    direction = np.empty(3)
    for i in range(len(ends)):
        reach = 0.0
        for axis in range(3):
            direction[axis] = ends[i, axis] - origin[axis]
            reach += direction[axis] * direction[axis]
        reach = np.sqrt(reach)
        if reach == 0:
            continue
        cosine = 0.0
        first, last = (free_from - 1) * reach, behind_m
        for axis in range(3):
            direction[axis] /= reach
            cosine += direction[axis] * normals[i, axis]
            if direction[axis] != 0:  # stay between both faces of the cube on this axis
                a = (-half_side - ends[i, axis]) / direction[axis]
                b = (half_side - ends[i, axis]) / direction[axis]
                first, last = max(first, min(a, b)), min(last, max(a, b))
            elif abs(ends[i, axis]) >= half_side:
                first, last = 1.0, 0.0
        if not first <= last:
            continue
        row = table[count]
        for axis in range(3):
            row[END + axis] = ends[i, axis]
            row[DIRECTION + axis] = direction[axis]
        row[LABEL] = 0
        row[SLOPE] = 1.0 if np.isnan(cosine) else max(abs(cosine), _MIN_COSINE)
        row[FREE_FROM] = first
        row[FREE_TO] = last
        count += 1
    return count


def ray_segments(
    rays: Rays,
    normals: NDArray[np.float64],
    centre: NDArray[np.float64],
    half_side_m: float,
    settings: ScanSettings,
) -> NDArray[np.float32]:
    """Segments of the rays that pass a region's cube, cut off at its faces.

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


def sample_segments(
    points: NDArray[np.float32], labels: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Segments without length that teach the signed distances ``labels`` [N] at points [N, 3]."""
    table = np.zeros((len(points), COLUMNS), np.float32)
    table[:, END : END + 3] = points
    table[:, LABEL] = labels
    return table
