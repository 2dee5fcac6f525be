"""Holes of a mesh tile: where its surface goes on in unknown space (``triquad_map.filling``)."""

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.cells import cells_of_boxes
from triquad_format.records.status import Status
from triquad_format.wire.limits import MAX_FILL_M
from triquad_map.composition.composed_view import ComposedView
from triquad_map.filling import FilledVoxels, filled_reach, filled_voxels

_GROUP_VOXELS = 8  # along the side of the groups that are searched first


def check_fill(fill_m: float) -> None:
    """Refuse a length up to which holes cannot be filled.

    Raises:
        RefusedError: it is not in the range.
    """
    if not 0 <= fill_m <= MAX_FILL_M:
        raise RefusedError(
            "bad_request", f"fill_m = {fill_m} is out of range: use 0 to {MAX_FILL_M:g}"
        )


def filled_in_box(source: ComposedView, low: Doubles, high: Doubles, fill_m: float) -> FilledVoxels:
    """The filled voxels that meet a box between two corners [3], metres, map frame.

    There may be others around it.
    """
    reach = filled_reach(fill_m, source.voxel_m)
    first = np.floor(low / source.voxel_m).astype(np.int64) - reach
    last = np.floor(high / source.voxel_m).astype(np.int64) + reach
    return filled_voxels(source, _seen_voxels(source, first, last), fill_m)


def cells_beside(filled: FilledVoxels, voxel_m: float, cell_m: float, reach_m: float) -> Longs:
    """The cells [C, 3] of a lattice that may hold faces up to ``reach_m`` from filled voxels."""
    middles, away_m = _middles(filled.voxels, voxel_m), (voxel_m + cell_m) / 2 + reach_m
    first = np.ceil((middles - away_m) / cell_m - 0.5).astype(np.int64)
    last = np.floor((middles + away_m) / cell_m - 0.5).astype(np.int64)
    return cells_of_boxes(first, last)[0]


def _seen_voxels(source: ComposedView, first: Longs, last: Longs) -> Longs:
    """The voxels [N, 3] with seen surface, of those from ``first`` to ``last`` [3] at least."""
    groups = _cells_between(first // _GROUP_VOXELS, last // _GROUP_VOXELS)
    side_m = _GROUP_VOXELS * source.voxel_m
    # As far as from the middle of a group to the middles of its outermost voxels.
    reach_m = (side_m - source.voxel_m) / 2
    seen = source.status(_middles(groups, side_m), reach_m) == Status.SURFACE
    within = _cells_between(np.zeros(3, np.int64), np.full(3, _GROUP_VOXELS - 1))
    voxels = (groups[seen][:, None] * _GROUP_VOXELS + within).reshape(-1, 3)
    ended = source.status(_middles(voxels, source.voxel_m), 0.0) == Status.SURFACE
    return np.asarray(voxels[ended])


def _middles(cells: Longs, side_m: float) -> Doubles:
    """The middles [N, 3] of cells [N, 3], metres, map frame."""
    return (cells.astype(np.float64) + 0.5) * side_m


def _cells_between(first: Longs, last: Longs) -> Longs:
    """All cells [C, 3] from ``first`` to ``last`` [3]."""
    steps = np.indices((last - first + 1).tolist()).reshape(3, -1).T
    return np.asarray(steps + first, np.int64)
