"""Which returns of a scan have others beside them: a surface gives several, a drop of rain one.

What is beside a return is told by the spacing of the scan's rays, so that a far wall, whose returns
lie metres apart, is as much a wall as a near one (as in Charron et al., De-noising of lidar point
clouds corrupted by snowfall, CRV 2018). The spacing is the scan's own: no sensor has to be known.
"""

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Ints

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import (
    Index,
    VoxelIndex,
    empty_keys,
    enter,
    find_row,
    make_row,
    pack,
)

_SPACINGS = 3.0  # of the rays, within which others count
_NEAREST = 1.0  # voxel, within which they count however dense the rays
_OTHERS = 2  # that a return on a surface has; of drops, two may be near each other
_PATCH = 0.25  # radians: the sensor's field of view is counted in patches of this side


def have_company(rays: Doubles) -> Bools:
    """Return which ends of ``rays`` [N, 3], voxels from the sensor, have others beside them."""
    reach = _SPACINGS * _spacing(rays, empty_keys(len(rays)))
    cells = VoxelIndex(max(16, len(rays)))
    return _have_company(rays, reach, cells.arrays, *np.empty((3, len(rays)), np.int32))


@kernel()
def _spacing(rays: Doubles, patches: np.ndarray) -> float:
    """Return the angle, radians, between neighbouring rays, were they spread evenly."""
    count = 0
    for x, y, z in rays:
        length = max(np.sqrt(x * x + y * y + z * z), 1e-9)
        count += enter(patches, x / length, y / length, z / length, _PATCH)
    # A sphere crosses 1.5 cubes of a lattice for each square of their side that it has.
    return float(np.sqrt(count * _PATCH**2 / 1.5 / max(len(rays), 1)))


@inner_kernel()
def _cell(ray: Doubles, reach: float) -> tuple[int, int, int]:
    """Return the cell of a ray's end: by direction, and by place near the sensor.

    All that is beside it lies in this cell and those next to it.
    """
    x, y, z = ray
    length = max(np.sqrt(x * x + y * y + z * z), _NEAREST / reach)
    side = reach * length
    return int(np.floor(x / side)), int(np.floor(y / side)), int(np.floor(z / side))


@kernel()
def _have_company(
    rays: Doubles, reach: float, cells: Index, own: Ints, last: Ints, before: Ints
) -> Bools:
    """Count the others of each ray, first in its ``own`` [N] cell, where most have enough.

    ``last`` [N] of each cell and those ``before`` [N] each make its list.
    """
    used = 0
    for i, ray in enumerate(rays):
        x, y, z = _cell(ray, reach)
        row = make_row(cells, used, pack(x, y, z))
        before[i] = last[row] if row < used else -1
        own[i], last[row] = row, i
        used = max(used, row + 1)
    found = np.zeros(len(rays), np.bool_)
    for i, ray in enumerate(rays):
        square = max(reach**2 * (ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2), _NEAREST**2)
        others = _count(rays, i, square, last[own[i]], before, -1)  # itself is none
        x, y, z = _cell(ray, reach)
        for k in range(27):
            if others >= _OTHERS:
                break
            row = find_row(cells, pack(x + k // 9 - 1, y + k // 3 % 3 - 1, z + k % 3 - 1))
            if row >= 0 and row != own[i]:
                others = _count(rays, i, square, last[row], before, others)
        found[i] = others >= _OTHERS
    return found


@inner_kernel()
def _count(rays: Doubles, i: int, square: float, j: int, before: Ints, others: int) -> int:
    """Add those of a list, which begins with ray ``j``, to the others beside ray ``i``."""
    while j >= 0 and others < _OTHERS:
        a, b, c = rays[i, 0] - rays[j, 0], rays[i, 1] - rays[j, 1], rays[i, 2] - rays[j, 2]
        others += a * a + b * b + c * c <= square
        j = before[j]
    return others
