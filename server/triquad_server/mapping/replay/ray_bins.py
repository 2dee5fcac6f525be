"""Bins of space in which rays end, for choosing rays to push out and finding those to forget.

A bin is a cube of four leaves; cubes that lie far apart may share one. Rays are rows of a
:class:`RayTable`.
"""

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints, Longs
from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.lanes import prefetch_row
from triquad_map.compiled.voxel_index import Index, find_row, pack

from triquad_server.mapping.replay.ray_table import COLUMNS, END, RayTable

BIN_LEAVES = 4.0
BINS = 1 << 18
_AHEAD = 16  # places that are fetched into the cache in advance


@inner_kernel()
def _bin(row: Floats, bin_m: float) -> int:
    mixed: int = np.int64(0)
    for axis, prime in enumerate((73856093, 19349663, 83492791)):
        mixed ^= int(np.floor(row[END + axis] / bin_m)) * prime
    return mixed & (BINS - 1)


@kernel()
def count_in_bins(rows: Floats, bin_m: float) -> Ints:
    """Count the rays [N] that end in each bin."""
    occupancy = np.zeros(BINS, np.int32)
    for i in range(len(rows)):
        occupancy[_bin(rows[i], bin_m)] += 1
    return occupancy


@kernel()
def best_to_push_out(
    size: int,
    count: int,
    first: int,
    stride: int,
    offset: int,
    rows: Floats,
    bin_m: float,
    occupancy: Ints,
) -> Longs:
    """Return ``count <= size // 2`` different places whose rays are the best to push out.

    The pool is paired up, each place once, and of a pair the one goes whose bin holds more.
    """
    half = size // 2
    chosen = np.empty(count, np.int64)
    for i in range(count):
        ahead = (first + (i + _AHEAD) * stride) % half
        prefetch_row(rows, ahead)
        prefetch_row(rows, half + (ahead + offset) % half)
        left = (first + i * stride) % half
        right = half + (left + offset) % half
        on_left, on_right = (
            occupancy[_bin(rows[left], bin_m)],
            occupancy[_bin(rows[right], bin_m)],
        )
        chosen[i] = left if on_left > on_right else right
    return chosen


@kernel()
def remove_at_random(
    chances: Doubles, bin_m: float, size: int, rows: Floats, origin_of: Ints, occupancy: Ints
) -> None:
    """Remove a ray for each of the ``chances`` [N] in [0, 1), and put the last one there."""
    for i in range(len(chances)):
        ahead = min(i + _AHEAD, len(chances) - 1)
        prefetch_row(rows, int(chances[ahead] * (size - ahead + i)))
        place = int(chances[i] * size)
        occupancy[_bin(rows[place], bin_m)] -= 1
        size -= 1
        rows[place], origin_of[place] = rows[size], origin_of[size]


@kernel()
def put_rays(
    new: RayTable,
    bin_m: float,
    places: Longs,
    used: int,
    rows: Floats,
    origin_of: Ints,
    occupancy: Ints,
) -> None:
    """Put new rays into places; those below ``used`` hold one that is pushed out."""
    for i in range(len(places)):
        prefetch_row(rows, places[min(i + _AHEAD, len(places) - 1)])
        place = places[i]
        if place < used:
            occupancy[_bin(rows[place], bin_m)] -= 1
        rows[place] = new.rows[i]
        origin_of[place] = new.origin_of[i]
        occupancy[_bin(new.rows[i], bin_m)] += 1


@kernel(inline="always")
def _voxel(row: Floats, leaf_m: float, middle: float) -> tuple[int, int, int]:
    return (
        int(np.floor(row[END] / leaf_m + middle)),
        int(np.floor(row[END + 1] / leaf_m + middle)),
        int(np.floor(row[END + 2] / leaf_m + middle)),
    )


@kernel()
def bins_of(voxels: Longs, leaf_m: float, middle: float) -> Bools:
    """Return which bins hold any part of ``voxels`` [N, 3]."""
    chosen = np.zeros(BINS, np.bool_)
    corner = np.zeros(COLUMNS, np.float32)
    for voxel in voxels:
        for number in range(8):
            for axis in range(3):
                inset = 0.99 if number >> axis & 1 else 0.01
                corner[END + axis] = (voxel[axis] + inset - middle) * leaf_m
            chosen[_bin(corner, BIN_LEAVES * leaf_m)] = True
    return chosen


@kernel()
def remove_ending_in(
    gone: Index,
    bins_of_gone: Bools,
    leaf_m: float,
    middle: float,
    size: int,
    rows: Floats,
    origin_of: Ints,
    occupancy: Ints,
) -> int:
    """Remove the rays that end in voxels, and put the last ones there; return the size."""
    i = 0
    while i < size:
        own_bin = _bin(rows[i], BIN_LEAVES * leaf_m)
        if bins_of_gone[own_bin]:
            x, y, z = _voxel(rows[i], leaf_m, middle)
            if find_row(gone, pack(x, y, z)) >= 0:
                occupancy[own_bin] -= 1
                size -= 1
                rows[i], origin_of[i] = rows[size], origin_of[size]
                continue
        i += 1
    return size
