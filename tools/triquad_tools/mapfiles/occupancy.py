"""Where a robot that stands on the ground can drive, as cells seen from above.

The ground of a place is what the lowest surface there is, as long as it goes on: a car's roof, a
table and the reflection of a wall below the floor are small pieces, higher or lower than what lies
around, and are none.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from triquad_client import OfflineMap, Status
from triquad_format.records.arrays import Bools, Doubles
from triquad_map.questions.distance import meets_surface
from triquad_map.questions.grid import GridShape

from triquad_tools.console.progress import Report
from triquad_tools.mapfiles.source import Box

STEP_M = 0.1
"""The robot drives over what is lower; as in docs/examples/costmap.py."""

HEIGHT_M = 1.4
"""The robot's; as there."""

_LEAST_GROUND_M2 = 8.0  # of a piece of ground: more than a car's roof; the largest always counts
_NEAR_M = 2.0  # so far around ground it tells how high things stand
_LEVEL_LEAVES = 1.5  # two columns of voxels are one piece where they differ by one voxel
_DROP_LEAVES = 2.5  # down to the ground, from half a leaf above the voxel that holds it
_BALL_CELLS = 0.55  # radius of what must be clear: nothing slips through between two cells
_AT_ONCE = 500_000  # cells

_Columns = NDArray[np.float64]  # [x, y] metres, map frame, of columns of voxels


@dataclass(frozen=True)
class Occupancy:
    """Cells from above. What is neither occupied nor free is unknown."""

    shape: GridShape  # of one layer
    occupied: Bools  # [x, y] something stands on the ground, or hangs lower than the robot is high
    free: Bools  # [x, y] the ground was seen, and nothing stands there


def occupancy(opened: OfflineMap, shape: GridShape, box: Box, report: Report) -> Occupancy:
    """Return where something stands between the step and the height of a robot above the ground.

    Args:
        opened: the map.
        shape: the cells, in one layer.
        box: surface in it counts.
        report: is told how much is done, of 1.
    """
    middles = opened.surface_voxels()
    middles = middles[((middles >= box[0]) & (middles <= box[1])).all(axis=1)]
    columns, rows, _ = shape.counts
    height, occupied = np.full(columns * rows, np.nan), np.zeros(columns * rows, np.bool_)
    if len(middles):
        levels = _levels(middles, opened.leaf_m)
        corner = middles[:, :2].min(axis=0) - opened.leaf_m / 2
        expected = _expected(levels, opened.leaf_m, corner, shape)
        asked = np.flatnonzero(np.isfinite(expected))
        for part in np.array_split(asked, len(asked) // _AT_ONCE + 1):
            height[part] = _ground(opened, _places(shape, part), expected[part])
        base = _lowest_around(height.reshape(columns, rows), opened.leaf_m, shape.cell_m).ravel()
        base = np.where(np.isfinite(base), base, expected)
        parts = np.array_split(asked, len(asked) // _AT_ONCE + 1)
        for number, part in enumerate(parts, start=1):
            occupied[part] = _stands(opened, _places(shape, part), base[part], shape.cell_m)
            report(number / len(parts), f"{number} of {len(parts)} parts")
    free = np.isfinite(height) & ~occupied
    return Occupancy(shape, occupied.reshape(columns, rows), free.reshape(columns, rows))


def _places(shape: GridShape, cells: NDArray[np.intp]) -> Doubles:
    """Return the middles [N, 2] of cells [N], numbered with y running fastest."""
    indices = np.stack(np.divmod(cells, shape.counts[1]), axis=1)
    return np.asarray(shape.corner[:2] + (indices + 0.5) * shape.cell_m, np.float64)


def _levels(middles: Doubles, leaf_m: float) -> tuple[_Columns, _Columns]:
    """Return the tops of the lowest voxels in which rays ended, and of those that hold ground.

    Columns without such a voxel have infinity, or NaN.
    """
    from scipy.sparse import coo_matrix  # slow to import
    from scipy.sparse.csgraph import connected_components

    x, y = np.rint((middles[:, :2] - middles[:, :2].min(axis=0)) / leaf_m).astype(np.int64).T
    lowest = np.full((x.max() + 1, y.max() + 1), np.inf)
    np.minimum.at(lowest, (x, y), middles[:, 2] + leaf_m / 2)
    known: Bools = np.isfinite(lowest)
    numbers = np.arange(lowest.size).reshape(lowest.shape)
    pairs: list[Any] = []
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        both = known[one] & known[other]
        rise = np.where(both, lowest[one], np.inf) - np.where(both, lowest[other], 0.0)
        level: Bools = np.abs(rise) < _LEVEL_LEAVES * leaf_m
        pairs.append(np.stack([numbers[one][level], numbers[other][level]]))
    ends = np.concatenate(pairs, axis=1)
    links = coo_matrix((np.ones(ends.shape[1], np.bool_), tuple(ends)), shape=(lowest.size,) * 2)
    pieces = connected_components(links, directed=False)[1].reshape(lowest.shape)
    sizes = np.bincount(pieces[known], minlength=pieces.max() + 1)
    large = sizes >= min(_LEAST_GROUND_M2 / leaf_m**2, sizes.max())
    return lowest, np.where(known & large[pieces], lowest, np.nan)


def _expected(
    levels: tuple[_Columns, _Columns], leaf_m: float, corner: Doubles, shape: GridShape
) -> Doubles:
    """Return about where the ground of each cell [N] is, NaN or infinite where nothing tells.

    It is that of the nearest piece of ground; far from any, the lowest surface stands on it.
    """
    from scipy.ndimage import distance_transform_edt

    lowest, ground = levels
    away, nearest = distance_transform_edt(np.isnan(ground), return_indices=True)
    around = np.where(away * leaf_m <= _NEAR_M, ground[tuple(nearest)], lowest)
    framed = np.pad(around, 1, constant_values=np.nan)
    at = [
        np.floor((start - edge + (np.arange(count) + 0.5) * shape.cell_m) / leaf_m)
        for start, edge, count in zip(shape.corner, corner, shape.counts, strict=False)
    ]
    rows = [
        np.clip(along, -1, count).astype(np.int64) + 1
        for along, count in zip(at, around.shape, strict=True)
    ]
    expected: Doubles = framed[np.ix_(*rows)].ravel()
    return expected


def _ground(opened: OfflineMap, places: Doubles, tops: Doubles) -> Doubles:
    """Return the height of the ground at places [N, 2] near ``tops`` [N], NaN where none is."""
    leaf_m = opened.leaf_m
    starts = np.column_stack([places, tops + leaf_m / 2])
    found = opened.query_ground(starts, _DROP_LEAVES * leaf_m)
    return np.where(found.status == Status.SURFACE, found.height_m, np.nan)


def _lowest_around(height: Doubles, leaf_m: float, cell_m: float) -> Doubles:
    """Return the lowest ground [x, y] within a leaf around, as far as edges are rounded off.

    So what rises by more than the step within a leaf stands in the way.
    """
    from scipy.ndimage import minimum_filter

    size = 2 * math.floor(leaf_m / cell_m + 1e-6) + 1
    lowest: Doubles = minimum_filter(np.where(np.isnan(height), np.inf, height), size)
    return lowest


def _stands(opened: OfflineMap, places: Doubles, base: Doubles, cell_m: float) -> Bools:
    """Return at which places [N, 2] a surface meets a ball, about as wide as a cell.

    It rises above ``base`` [N] from the step to the robot's height, as far at a time as is clear.
    """
    radius_m = _BALL_CELLS * cell_m
    stands, heights = np.zeros(len(places), np.bool_), base + STEP_M + radius_m
    highest = np.maximum(heights, base + HEIGHT_M - radius_m)
    rising = np.arange(len(places))
    while len(rising):
        points = np.column_stack([places[rising], heights[rising]])
        found = opened.query_distance(points, HEIGHT_M)
        stands[rising] = meets_surface(found.distance_m, found.status, radius_m)
        clear_m = np.maximum(np.abs(found.distance_m) - radius_m, radius_m)
        left = ~stands[rising] & (heights[rising] < highest[rising])
        rising, clear_m = rising[left], clear_m[left]
        heights[rising] = np.minimum(heights[rising] + clear_m, highest[rising])
    return stands
