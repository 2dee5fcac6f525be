"""Finds the owners of many points in compiled code."""

from collections.abc import Sequence

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Ints, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_index import CELL_LIMIT, Index, VoxelIndex, find_row, pack
from triquad_map.composition.region_lattice import Owned, Owners, core_m

_NOBODY = -1


@kernel()
def _find_owners(
    points: Doubles, pitch_m: float, core_m: float, index: Index, owners: Ints, shared: Bools
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
def _sorted_by(regions: Ints, count: int) -> tuple[Longs, Longs]:
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


class CompiledLattice:
    """As :class:`~triquad_map.composition.region_lattice.RegionLattice`, and faster."""

    def __init__(self, settings: FieldSettings, regions: Sequence[RegionIndex]) -> None:
        self._pitch_m = settings.region_pitch_m
        self._core_m = core_m(settings)
        cells = np.array(regions, np.int64).reshape(-1, 3)
        self._index = VoxelIndex.of_cells(cells).arrays

    def owners(self, points: Doubles) -> Owners:
        """Who answers for points [N, 3], metres, map frame."""
        regions, shared = np.empty(len(points), np.int32), np.empty(len(points), np.bool_)
        points = np.ascontiguousarray(points)
        _find_owners(points, self._pitch_m, self._core_m, self._index, regions, shared)
        return Owners(_groups(regions), shared)


def _groups(regions: Ints) -> list[Owned]:
    """The points of each region, given the number of the one that owns each point [N]."""
    if len(regions) == 0:
        return []
    first, last = int(regions.min()), int(regions.max())
    if first == last:
        return [Owned(first, slice(None))] if first >= 0 else []
    order, starts = _sorted_by(regions, last + 1)
    return [
        Owned(region, order[starts[region] : starts[region + 1]])
        for region in range(last + 1)
        if starts[region] < starts[region + 1]
    ]
