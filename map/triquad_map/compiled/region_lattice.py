"""Which region answers for a point.

Regions stand on a fixed lattice and overlap. Each point is owned by the region whose centre is
nearest; in its core, away from the overlap with others, it is the only one that covers it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_index import CELL_LIMIT, Index, VoxelIndex, find_row, pack

_NOBODY = -1


@kernel()
def _find_owners(
    points: NDArray[np.float64],
    pitch_m: float,
    core_m: float,
    index: Index,
    owners: NDArray[np.int32],
    shared: NDArray[np.bool_],
) -> None:
    for i in range(len(points)):
        owners[i] = _NOBODY
        shared[i] = False
        x, y, z = points[i, 0] / pitch_m, points[i, 1] / pitch_m, points[i, 2] / pitch_m
        limit = CELL_LIMIT - 1
        if not (abs(x) < limit and abs(y) < limit and abs(z) < limit):  # NaN is nobody's either
            continue
        a, b, c = np.floor(x + 0.5), np.floor(y + 0.5), np.floor(z + 0.5)
        owners[i] = find_row(index, pack(int(a), int(b), int(c)))
        off = max(abs(x - a), abs(y - b), abs(z - c)) * pitch_m
        shared[i] = off > core_m


@kernel()
def _sorted_by(
    regions: NDArray[np.int32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The points in the order of their regions, and where each of ``count`` regions begins.

    Points without a region come first.
    """
    starts = np.zeros(count + 2, np.int64)
    for region in regions:
        starts[region + 2] += 1
    for i in range(1, count + 2):
        starts[i] += starts[i - 1]
    order = np.empty(len(regions), np.int64)
    free = starts[:-1].copy()
    for i in range(len(regions)):
        order[free[regions[i] + 1]] = i
        free[regions[i] + 1] += 1
    return order, starts[1:]


@dataclass(frozen=True)
class Owned:
    """Points of a query that one region answers for."""

    region: int  # its number
    points: slice | NDArray[np.int64]  # which of the query's


@dataclass(frozen=True)
class Owners:
    """Who answers for N points."""

    regions: NDArray[np.int32]  # [N] number of the region that owns each point; -1: none
    shared: NDArray[np.bool_]  # [N] whether other regions may cover it, too

    def groups(self) -> Iterator[Owned]:
        """The points that have an owner, region by region."""
        if len(self.regions) == 0:
            return
        first, last = int(self.regions.min()), int(self.regions.max())
        if first == last:
            if first >= 0:
                yield Owned(first, slice(None))
            return
        order, starts = _sorted_by(self.regions, last + 1)
        for region in range(last + 1):
            if starts[region] < starts[region + 1]:
                yield Owned(region, order[starts[region] : starts[region + 1]])


class RegionLattice:
    """The regions of a map, by place; their numbers are their order."""

    def __init__(self, settings: FieldSettings, regions: list[RegionIndex]) -> None:
        self._pitch_m = settings.region_pitch_m
        self._core_m = settings.region_side_m / 2 - settings.overlap_m
        cells = np.array(regions, np.int64).reshape(-1, 3)
        self._index = VoxelIndex.of_cells(cells).arrays

    def owners(self, points: NDArray[np.float64]) -> Owners:
        """Who answers for points [N, 3], metres, map frame."""
        found = Owners(np.empty(len(points), np.int32), np.empty(len(points), np.bool_))
        points = np.ascontiguousarray(points)
        _find_owners(points, self._pitch_m, self._core_m, self._index, found.regions, found.shared)
        return found
