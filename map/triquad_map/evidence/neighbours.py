"""What the neighbours of a return in its scan tell: if it lies on a surface, and how that extends.

A return has company if two others on neighbouring rays end at its range, or if it ends no nearer
than two in five of them do: a drop of rain or a grain of dust hangs before what its neighbours
meet. Rays are neighbours by their spacing, so that a far wall, whose returns lie metres apart, is
as much a wall as a near one (as in Charron et al., De-noising of lidar point clouds corrupted by
snowfall, CRV 2018). The spacing is the scan's own: no sensor has to be known.

The surface extends towards those that end at its range, and so through the voxel: along a post, all
over the back of a car, along ground that is grazed.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Ints, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.team import Split, in_one
from triquad_map.compiled.voxel_index import (
    Index,
    VoxelIndex,
    empty_keys,
    enter,
    find_row,
    make_row,
    pack,
)
from triquad_map.evidence.observed import FILLED
from triquad_map.evidence.ray_surfels import MOMENTS, add_points

_SPACINGS = 3.0
"""Spacings of a scan's rays within which two are neighbours: some 28 are, of each."""

_SAME_RANGE = 1.0
"""The largest difference of the ranges of two returns on one surface, in voxels. With three
spacings of the rays instead, 1.5 % of drops are surface, not 0.9."""

_OTHERS = 2
"""Returns at the same range that one on a surface has: of drops, two may be near each other."""

_SHARE = 0.4
"""The share of its neighbours than which such a return ends no nearer. Smooth ground has just half:
with 0.5, a corridor at 16 beams loses 1 % of what stands at the first scan."""

_MOST_COMPARED = 256  # rays with one: where they are spread evenly, some 100 are near enough
_LEAST_ASKED = 512  # rays; of fewer, a thread of its own gains nothing
_PATCH = 0.25  # radians: the sensor's field of view is counted in patches of this side


class _Rays(NamedTuple):
    """The rays of a scan, and lists of those whose directions lie in one cell."""

    directions: Doubles  # [N, 3] unit vectors
    ranges: Doubles  # [N] voxels
    reach: float  # radians, within which rays are neighbours: the side of a cell
    cells: Index
    last: Ints  # [cells] the last ray of each
    before: Ints  # [N] the one before each ray in its cell; -1: none


class Neighbourhoods(NamedTuple):
    """What the neighbours of some returns tell."""

    have_company: Bools  # [M]
    extents: Doubles  # [M, 6] covariances of the surface in a voxel: xx, xy, xz, yy, yz, zz, voxels


def ask_neighbours(rays: Doubles, chosen: Longs, split: Split = in_one) -> Neighbourhoods:
    """Return what the neighbours of the ``chosen`` [M] rays tell.

    Args:
        rays: ends [N, 3] of all rays of a scan, voxels from the sensor.
        chosen: numbers of those that are asked about.
        split: shares the work.
    """
    directions, ranges = _directions(rays)
    reach = _SPACINGS * _spacing(directions, empty_keys(len(rays)))
    cells = VoxelIndex(max(16, len(rays))).arrays
    last, before = np.empty((2, len(rays)), np.int32)
    of_scan = _Rays(directions, ranges, reach, cells, last, before)
    _enter_cells(of_scan)
    have_company, moments = np.zeros(len(chosen), np.bool_), np.zeros((len(chosen), MOMENTS))

    def ask(first: int, last: int) -> None:
        part = slice(first, last)
        _ask_some(of_scan, chosen[part], have_company[part], moments[part])

    split(len(chosen), ask, least=_LEAST_ASKED)
    return Neighbourhoods(have_company, moments[:, 4:])


@kernel()
def _directions(rays: Doubles) -> tuple[Doubles, Doubles]:
    """Return unit vectors [N, 3] and lengths [N] of rays."""
    directions, ranges = np.empty(rays.shape), np.empty(len(rays))
    for i, (x, y, z) in enumerate(rays):
        ranges[i] = np.sqrt(x * x + y * y + z * z)
        for axis in range(3):
            directions[i, axis] = rays[i, axis] / max(ranges[i], 1e-9)
    return directions, ranges


@kernel()
def _spacing(directions: Doubles, patches: np.ndarray) -> float:
    """Return the angle, radians, between neighbouring rays, were they spread evenly."""
    count = 0
    for x, y, z in directions:
        count += enter(patches, x, y, z, _PATCH)
    # A sphere crosses 1.5 cubes of a lattice for each square of their side that it has.
    return float(np.sqrt(count * _PATCH**2 / 1.5 / max(len(directions), 1)))


@inner_kernel()
def _cell(i: int, rays: _Rays) -> tuple[int, int, int]:
    """Return the cell of a ray's direction; its neighbours lie there or in those next to it."""
    x, y, z = rays.directions[i]
    return (
        int(np.floor(x / rays.reach)),
        int(np.floor(y / rays.reach)),
        int(np.floor(z / rays.reach)),
    )


@inner_kernel()
def _are_neighbours(i: int, j: int, rays: _Rays) -> bool:
    """Return whether two rays are neighbours."""
    one, other = rays.directions[i], rays.directions[j]
    x, y, z = one[0] - other[0], one[1] - other[1], one[2] - other[2]
    return bool(x * x + y * y + z * z <= rays.reach * rays.reach)


@kernel()
def _enter_cells(rays: _Rays) -> None:
    """Enter each ray in the list of its cell."""
    used = 0
    for i in range(len(rays.ranges)):
        x, y, z = _cell(i, rays)
        row = make_row(rays.cells, used, pack(x, y, z))
        rays.before[i] = rays.last[row] if row < used else -1
        rays.last[row] = i
        used = max(used, row + 1)


@kernel()
def _ask_some(rays: _Rays, chosen: Longs, have_company: Bools, moments: Doubles) -> None:
    for n, i in enumerate(chosen):
        have_company[n] = _ask(i, rays, moments[n])


@inner_kernel()
def _ask(i: int, rays: _Rays, moments: Doubles) -> bool:
    """Return whether a ray has company; ``moments`` tell how the surface extends where it ends."""
    x, y, z = _cell(i, rays)
    compared, count, same, no_farther = 0, 0, 0, 0
    for k in range(27):
        n = (k + 13) % 27  # its own cell comes first
        row = find_row(rays.cells, pack(x + n // 9 - 1, y + n // 3 % 3 - 1, z + n % 3 - 1))
        j = rays.last[row] if row >= 0 else -1
        while j >= 0 and compared < _MOST_COMPARED:
            compared += 1
            if j != i and _are_neighbours(i, np.int64(j), rays):
                farther = rays.ranges[j] - rays.ranges[i]
                count += 1
                no_farther += farther <= _SAME_RANGE
                if abs(farther) <= _SAME_RANGE:
                    same += 1
                    _extend(i, np.int64(j), rays, moments)
            j = rays.before[j]
    if same == 0:  # nothing tells where to: it may be anywhere in the voxel
        moments[4] = moments[7] = moments[9] = FILLED
    else:
        moments *= 2 * FILLED / same
    return same >= _OTHERS or (no_farther >= _OTHERS and no_farther >= _SHARE * count)


@inner_kernel()
def _extend(i: int, j: int, rays: _Rays, moments: Doubles) -> None:
    """Add the direction from one ray's end to another's to the moments of such directions."""
    one, other = rays.directions[i], rays.directions[j]
    x = rays.ranges[j] * other[0] - rays.ranges[i] * one[0]
    y = rays.ranges[j] * other[1] - rays.ranges[i] * one[1]
    z = rays.ranges[j] * other[2] - rays.ranges[i] * one[2]
    add_points(moments, (x, y, z), 1 / max(x * x + y * y + z * z, 1e-12))
