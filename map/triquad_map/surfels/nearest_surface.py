"""The nearest surface of points of the map frame, by the surfels of a region."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.surface import HALF_LIFE_S, SurfelKind
from triquad_map.surfels.surfel_search import NearestSurfels, find_nearest, no_surfels
from triquad_map.surfels.surfel_tree import SurfelTree
from triquad_map.view import NO_LENGTH_M, NearestSurface

_RAY_DISC = int(SurfelKind.RAY_DISC)


class RegionFrame(NamedTuple):
    """The place of a region's leaf coordinates in the map, and the time of the query."""

    corner: tuple[float, float, float]  # where they are 0, metres, map frame
    leaf_m: float
    newest_s: int  # when anything in the map was seen last, seconds since 1970


class ShownSurfels(NamedTuple):
    """The properties of surfels that were found."""

    kinds: Bytes  # [S]
    normals: Floats  # [S, 3]
    confidence: Floats  # [S]
    seen_s: Longs  # [S]


@inner_kernel()
def _write(
    i: int, place: Doubles, found: NearestSurfels, frame: RegionFrame, nearest: NearestSurface
) -> None:
    """Write where the surface lies that was found for point ``i``, and which way it is."""
    nearest.found[i] = True
    nearest.distance[i] = found.distances[i] * frame.leaf_m
    square = 0.0
    for axis in range(3):
        nearest.point[i, axis] = found.closest[i, axis] * frame.leaf_m + frame.corner[axis]
        away = place[axis] - found.means[i, axis]
        nearest.gradient[i, axis] = away
        square += away * away
    length = np.sqrt(square)
    for axis in range(3):
        if length * frame.leaf_m > NO_LENGTH_M:
            nearest.gradient[i, axis] /= length
        else:
            nearest.gradient[i, axis] = 0.0


@kernel()
def improve_nearest(
    points: Doubles,
    tree: SurfelTree,
    shown: ShownSurfels,
    frame: RegionFrame,
    nearest: NearestSurface,
) -> None:
    """Improve ``nearest`` where a surfel lies nearer to ``points`` [N, 3] of the map frame."""
    places = (points - np.array(frame.corner)) / frame.leaf_m
    found = no_surfels(nearest.distance / frame.leaf_m)
    find_nearest(places, tree, found)
    for i in range(len(points)):
        row = found.rows[i]
        if row < 0:
            continue
        _write(i, places[i], found, frame, nearest)
        age_s = max(frame.newest_s - shown.seen_s[row], 0)
        nearest.confidence[i] = shown.confidence[row] * np.exp2(-age_s / HALF_LIFE_S)
        nearest.learnt[i] = shown.kinds[row] < _RAY_DISC
        for axis in range(3):
            is_facing = shown.kinds[row] == _RAY_DISC
            nearest.normal[i, axis] = shown.normals[row, axis] if is_facing else np.float32(0)
