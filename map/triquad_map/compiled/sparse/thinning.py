"""Fewer points that cover the same space: the first in each cell of a grid."""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Longs

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_index import empty_keys, find_slot, pack


@kernel(inline="always")
def enter(keys: Longs, x: float, y: float, z: float, cell_m: float) -> bool:
    """Put the cell of a point into a set; False where it is there already."""
    key = pack(int(np.floor(x / cell_m)), int(np.floor(y / cell_m)), int(np.floor(z / cell_m)))
    slot = find_slot(keys, key)
    if keys[slot] == key:
        return False
    keys[slot] = key
    return True


@kernel()
def _first_per_cell(points: NDArray[np.floating], cell_m: float, keys: Longs) -> Bools:
    chosen = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        chosen[i] = enter(keys, points[i, 0], points[i, 1], points[i, 2], cell_m)
    return chosen


def thin(points: NDArray[np.floating], cell_m: float) -> Bools:
    """Mask [N] that keeps one of the points [N, 3] per cell of side ``cell_m``, the first."""
    return np.asarray(
        _first_per_cell(np.ascontiguousarray(points), cell_m, empty_keys(len(points)))
    )
