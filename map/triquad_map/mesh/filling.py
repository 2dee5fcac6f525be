"""Continues surface that no ray has met: from seen surface into unknown space, step by step.

The field answers everywhere, also where nobody taught it, and there most of its zeros are no
surface. Those that are lie in line with what was seen next to them, and around them the field still
rises as a distance does. So surface is continued from each voxel with seen surface to the voxels
around it, from these to the next, and so on: into a voxel that is ``UNKNOWN``, never into a
``FREE`` one, where the field has a surface that lies in one plane with that of the voxel before.
``docs/design.md`` says how much of what is found so is right.

Voxels have the side of a leaf and are named by integer coordinates in the map frame: the voxel
``v`` is the cube ``[v, v + 1)`` of positions in voxels.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.cells import CellIndex, cells_of_boxes, same_cells
from triquad_format.records.status import Status

from triquad_map.composition.composed_view import ComposedView
from triquad_map.surface import FieldValues, SampleField, SurfelKind, fit_surfels

_STEEPNESS = 0.7
"""The least share of the way from a voxel behind a surface to a voxel before it by which the field
rises."""

_OFF_PLANE = 0.25
"""The most that the surface in each of two neighbouring voxels lies off the other's plane, in
voxels."""

_AROUND = np.array([step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]) - 1  # [26, 3]


@dataclass(frozen=True)
class FilledVoxels:
    """Unknown voxels into which seen surface goes on."""

    voxels: Longs  # [M, 3]
    sources: Longs  # [M, 3] the voxel with seen surface from which each was reached
    fill_m: float  # how far from these the surface goes on


@dataclass(frozen=True)
class _Patches:
    """The surface within N voxels, in each a piece of a plane."""

    voxels: Longs  # [N, 3]
    points: Doubles  # [N, 3] on it, in voxels
    normals: Doubles  # [N, 3] unit vectors to free space
    sources: Longs  # [N, 3] as of FilledVoxels

    def chosen(self, rows: Bools | NDArray[np.intp]) -> "_Patches":
        """Return some of them, ``rows``."""
        return _Patches(*(array[rows] for array in vars(self).values()))


def filled_voxels(view: ComposedView, low: Doubles, high: Doubles, fill_m: float) -> FilledVoxels:
    """Return the voxels into which surface goes on that meet a box; there may be others around it.

    Args:
        view: the map.
        low: [3] metres, map frame: the box's minimum corner.
        high: [3] the maximum corner.
        fill_m: how far from seen surface, metres.
    """
    parts = [np.zeros((2, 0, 3), np.int64)]
    limit = fill_m / view.voxel_m
    steps = math.ceil(limit)
    known = _seen_voxels(view, low, high, margin=steps)
    field = _field_in_voxels(view)
    front = _seen_patches(field, known)
    while len(front.voxels) and len(parts) <= steps:
        front = _next_front(view, field, front, known, limit=limit)
        parts.append(np.stack([front.voxels, front.sources]))
        known = np.concatenate([known, front.voxels])
    voxels, sources = np.concatenate(parts, axis=1)
    return FilledVoxels(voxels, sources, fill_m)


def cells_around(filled: FilledVoxels, voxel_m: float, cell_m: float, reach_m: float) -> Longs:
    """Return cells [C, 3] of a lattice that may have faces up to ``reach_m`` from filled voxels."""
    middles, away_m = _middles(filled.voxels) * voxel_m, (voxel_m + cell_m) / 2 + reach_m
    first = np.ceil((middles - away_m) / cell_m - 0.5).astype(np.int64)
    last = np.floor((middles + away_m) / cell_m - 0.5).astype(np.int64)
    return cells_of_boxes(first, last)[0]


def _seen_voxels(view: ComposedView, low: Doubles, high: Doubles, margin: int) -> Longs:
    """Return the voxels [N, 3] with seen surface, up to ``margin`` voxels around a box at least."""
    first = np.floor(low / view.voxel_m).astype(np.int64) - margin
    last = np.floor(high / view.voxel_m).astype(np.int64) + margin
    middles = _middles(first[:, None] + np.arange((last - first).max() + 1)) * view.voxel_m
    seen = np.argwhere(view.surface_in_grid(middles, 0.0)) + first
    return np.ascontiguousarray(seen)  # as kernels are compiled for


def _field_in_voxels(view: ComposedView) -> SampleField:
    def sample(places: Doubles) -> FieldValues:
        answer = view.query(places * view.voxel_m, gradient=True)
        return FieldValues(answer.sdf / np.float32(view.voxel_m), answer.gradient)

    return sample


def _seen_patches(field: SampleField, seen: Longs) -> _Patches:
    """Return the surface of voxels ``seen`` [N, 3]: in them, or just next to them in the field."""
    patches, kinds = _patches(field, seen)
    return patches.chosen((kinds == SurfelKind.DISC) | (kinds == SurfelKind.NONE))


def _patches(field: SampleField, voxels: Longs) -> tuple[_Patches, Bytes]:
    """Return the surface of ``voxels`` [N, 3], their own sources, and the kinds [N] of surfels."""
    surfels = fit_surfels(voxels, field, lambda beside: np.ones(len(beside), np.bool_))
    points = _middles(voxels) + surfels.offsets
    return _Patches(voxels, points, surfels.normals.astype(np.float64), voxels), surfels.kinds


def _next_front(
    view: ComposedView, field: SampleField, front: _Patches, known: Longs, limit: float
) -> _Patches:
    """Return the surface of ``front`` where it goes on in voxels next to it, not ``known``."""
    before = np.repeat(np.arange(len(front.voxels)), len(_AROUND))
    voxels = front.voxels[before] + np.tile(_AROUND, (len(front.voxels), 1))
    first = same_cells(voxels)[0]
    fresh = first[CellIndex(known).rows_of(voxels[first]) < 0]
    patches = _distance_like(view, field, voxels[fresh])
    after = CellIndex(patches.voxels).rows_of(voxels)
    pairs = np.flatnonzero(after >= 0)
    pairs = pairs[_aligned(front.chosen(before[pairs]), patches.chosen(after[pairs]))]
    sources = front.sources[before[pairs]]
    away = _box_distances(patches.points[after[pairs]], sources)
    # Each from the nearest seen surface that it goes on from; whatever the order of the voxels.
    order = np.lexsort((*sources.T, away, after[pairs]))
    order = order[away[order] <= limit]
    reached, first = np.unique(after[pairs[order]], return_index=True)
    return dataclasses.replace(patches.chosen(reached), sources=sources[order[first]])


def _distance_like(view: ComposedView, field: SampleField, voxels: Longs) -> _Patches:
    """Return the surface in unknown ones of ``voxels`` [N, 3], where it is a distance's zero."""
    unknown = view.status(_middles(voxels) * view.voxel_m, 0.0) == Status.UNKNOWN
    patches, kinds = _patches(field, voxels[unknown])
    patches = patches.chosen(kinds == SurfelKind.DISC)
    rise = field(patches.points + patches.normals).sdf
    rise -= field(patches.points - patches.normals).sdf
    return patches.chosen(rise >= 2 * _STEEPNESS)


def _aligned(one: _Patches, other: _Patches) -> Bools:
    """Return whether patches [N] lie in one plane with ``other`` ones, as far as can be asked."""
    way = other.points - one.points
    off = [np.abs((way * patches.normals).sum(axis=1)) for patches in (one, other)]
    return np.asarray(np.maximum(*off) <= _OFF_PLANE)


def on_filled(view: ComposedView, filled: FilledVoxels, points: Doubles, reach_m: float) -> Bools:
    """Return whether points [N, 3], metres, map frame, of a surface lie where it was continued.

    That is up to ``reach_m`` from a voxel with seen surface, of which they are in a part that was
    not seen; or so far from a filled voxel on each axis, at most ``fill_m`` from the voxel with
    seen surface at which that began, and not in a ``FREE`` voxel.
    """
    found = _beside_filled(filled, points / view.voxel_m, view.voxel_m, reach_m=reach_m)
    found |= view.status(points, reach_m) == Status.SURFACE
    at = np.flatnonzero(found)
    found[at] = view.status(points[at], 0.0) != Status.FREE
    return found


def _beside_filled(filled: FilledVoxels, places: Doubles, voxel_m: float, reach_m: float) -> Bools:
    """Do as :func:`on_filled`, of filled voxels alone and of ``places`` [N, 3] in voxels."""
    found = np.zeros(len(places), np.bool_)
    if not len(filled.voxels):
        return found
    index = CellIndex(filled.voxels)
    reach, limit = reach_m / voxel_m, filled.fill_m / voxel_m
    low, high = filled.voxels.min(axis=0) - 1, filled.voxels.max(axis=0) + 2
    inside = ((places >= low) & (places < high)).all(axis=1)
    for shift in np.ndindex(2, 2, 2):
        left = np.flatnonzero(inside & ~found)
        near = np.floor(places[left] + (2 * np.array(shift) - 1) * reach).astype(np.int64)
        rows = index.rows_of(near)
        is_within = _box_distances(places[left], filled.sources[rows]) <= limit
        found[left] = (rows >= 0) & is_within
    return found


def _middles(voxels: Longs) -> Doubles:
    """Return the middles [N, 3] of voxels [N, 3], in voxels."""
    return voxels.astype(np.float64) + 0.5


def _box_distances(points: Doubles, voxels: Longs) -> Doubles:
    """Return distances [N] of points [N, 3] from voxels [N, 3], in voxels."""
    outside = np.maximum(np.maximum(voxels - points, points - voxels - 1.0), 0.0)
    return np.asarray(np.linalg.norm(outside, axis=1))
