"""Where surface goes on that no ray has met: from seen surface into unknown space, step by step.

The field answers everywhere, also where nobody taught it, and there most of its zeros are no
surface. Those that are lie in line with what was seen beside them, and around them the field still
rises as a distance does. So surface is continued from each voxel with seen surface to the voxels
around it, from these to the next, and so on: into a voxel that is ``UNKNOWN``, never into a
``FREE`` one, where the field has a surface that lies in one plane with that of the voxel before.
``docs/design.md`` tells how much of what is found so is right.

Voxels have the side of a leaf and are named by integer coordinates in the map frame: the voxel
``v`` is the cube ``[v, v + 1)`` of positions in voxels.
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.cells import cell_names, cells_of_boxes, rows_by_cell
from triquad_format.records.status import Status

from triquad_map.surface import FieldSample, SampleField, SurfelKind, fit_surfels
from triquad_map.view import MapView

_STEEPNESS = 0.7
"""From a voxel behind a surface to a voxel before it the field rises by at least so much of the
way."""

_COSINE = 0.9
"""Of the angle between the normals of surface in two neighbouring voxels, at least."""

_OFF_PLANE = 0.25
"""How far the surface in each of them lies off the other's plane at most, in voxels."""

_CUBE_VOXELS = 64
"""Along the side of the part of a map that is worked at in one go."""

_AROUND = np.array([step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]) - 1  # [26, 3]


@dataclass(frozen=True)
class FilledVoxels:
    """Unknown voxels into which seen surface goes on."""

    voxels: Longs  # [M, 3]
    sources: Longs  # [M, 3] the voxel with seen surface from which each was reached

    def chosen(self, rows: Bools | NDArray[np.intp]) -> "FilledVoxels":
        """Some of them, ``rows``."""
        return FilledVoxels(self.voxels[rows], self.sources[rows])

    @classmethod
    def joined(cls, parts: Iterable["FilledVoxels"]) -> "FilledVoxels":
        """All of several parts."""
        voxels, sources = [np.zeros((0, 3), np.int64)], [np.zeros((0, 3), np.int64)]
        for part in parts:
            voxels.append(part.voxels)
            sources.append(part.sources)
        return cls(np.concatenate(voxels), np.concatenate(sources))


@dataclass(frozen=True)
class _Patches:
    """The surface within N voxels, in each a piece of a plane."""

    voxels: Longs  # [N, 3]
    points: Doubles  # [N, 3] on it, in voxels
    normals: Doubles  # [N, 3] unit vectors to free space
    sources: Longs  # [N, 3] as of FilledVoxels

    def chosen(self, rows: Bools | NDArray[np.intp]) -> "_Patches":
        """Some of them, ``rows``."""
        return _Patches(*(array[rows] for array in vars(self).values()))


def filled_reach(fill_m: float, voxel_m: float) -> int:
    """How many voxels the surface goes on at most along each axis."""
    return math.ceil(fill_m / voxel_m)


def filled_voxels(view: MapView, seen: Longs, fill_m: float) -> FilledVoxels:
    """The voxels into which the surface goes on, at most ``fill_m`` metres from seen surface.

    Args:
        view: the map.
        seen: [N, 3] each once, the voxels with seen surface; of a part of the map, those in it and
            up to :func:`filled_reach` voxels around it.
        fill_m: metres; 0: none.
    """
    reach = filled_reach(fill_m, view.voxel_m)
    if reach == 0:
        return FilledVoxels.joined([])
    cubes, rows = cells_of_boxes((seen - reach) // _CUBE_VOXELS, (seen + reach) // _CUBE_VOXELS)
    parts = []
    for cube, here in rows_by_cell(cubes):
        found = _continued(view, seen[rows[here]], fill_m / view.voxel_m, steps=reach)
        parts.append(found.chosen((found.voxels // _CUBE_VOXELS == cube).all(axis=1)))
    return FilledVoxels.joined(parts)


def _continued(view: MapView, seen: Longs, limit: float, steps: int) -> FilledVoxels:
    """Where the surface of ``seen`` [N, 3] goes on, up to ``limit`` voxels, in so many steps."""
    field = _field_in_voxels(view)
    known = seen
    front = _seen_patches(field, seen)
    parts = []
    for _ in range(steps):
        front = _next_front(view, field, front, known, limit=limit)
        if not len(front.voxels):
            break
        parts.append(FilledVoxels(front.voxels, front.sources))
        known = np.concatenate([known, front.voxels])
    return FilledVoxels.joined(parts)


def _field_in_voxels(view: MapView) -> SampleField:
    def sample(places: Doubles) -> FieldSample:
        answer = view.query(places * view.voxel_m, gradient=True)
        return FieldSample(answer.sdf / np.float32(view.voxel_m), answer.gradient)

    return sample


def _seen_patches(field: SampleField, seen: Longs) -> _Patches:
    """The surface of the voxels ``seen`` [N, 3]: in them, or just beside where the field has it."""
    patches, kinds = _patches(field, seen)
    return patches.chosen((kinds == SurfelKind.DISC) | (kinds == SurfelKind.NONE))


def _patches(field: SampleField, voxels: Longs) -> tuple[_Patches, Bytes]:
    """The surface of ``voxels`` [N, 3], as their own sources, and the kinds [N] of its surfels."""
    surfels = fit_surfels(voxels, field, lambda beside: np.ones(len(beside), np.bool_))
    points = _middles(voxels) + surfels.offsets
    return _Patches(voxels, points, surfels.normals.astype(np.float64), voxels), surfels.kinds


def _next_front(
    view: MapView, field: SampleField, front: _Patches, known: Longs, limit: float
) -> _Patches:
    """The surface of ``front`` where it goes on in voxels beside it that are not ``known``."""
    before = np.repeat(np.arange(len(front.voxels)), len(_AROUND))
    voxels = front.voxels[before] + np.tile(_AROUND, (len(front.voxels), 1))
    least = known.min(axis=0) - 1
    names = cell_names(voxels - least)
    _, first = np.unique(names, return_index=True)
    fresh = first[~np.isin(names[first], cell_names(known - least))]
    patches = _distance_like(view, field, voxels[fresh])
    after = _rows(cell_names(patches.voxels - least), names)
    pairs = np.flatnonzero(after >= 0)
    pairs = pairs[_aligned(front.chosen(before[pairs]), patches.chosen(after[pairs]))]
    sources = front.sources[before[pairs]]
    away = _box_distances(patches.points[after[pairs]], sources)
    # Each from the nearest seen surface that it goes on from; whatever the order of the voxels.
    order = np.lexsort((*sources.T, away, after[pairs]))
    order = order[away[order] <= limit]
    reached, first = np.unique(after[pairs[order]], return_index=True)
    return dataclasses.replace(patches.chosen(reached), sources=sources[order[first]])


def _distance_like(view: MapView, field: SampleField, voxels: Longs) -> _Patches:
    """The surface in those of ``voxels`` [N, 3] that are unknown, where it is a distance's zero."""
    unknown = view.status(_middles(voxels) * view.voxel_m, 0.0) == Status.UNKNOWN
    patches, kinds = _patches(field, voxels[unknown])
    patches = patches.chosen(kinds == SurfelKind.DISC)
    rise = field(patches.points + patches.normals).values
    rise -= field(patches.points - patches.normals).values
    return patches.chosen(rise >= 2 * _STEEPNESS)


def _aligned(one: _Patches, other: _Patches) -> Bools:
    """Whether patches [N] lie in one plane with the ``other`` ones, as far as can be asked."""
    way = other.points - one.points
    level: Bools = (one.normals * other.normals).sum(axis=1) >= _COSINE
    for normals in (one.normals, other.normals):
        level &= np.abs((way * normals).sum(axis=1)) <= _OFF_PLANE
    return level


def on_filled(
    view: MapView, filled: FilledVoxels, points: Doubles, reach_m: float, fill_m: float
) -> Bools:
    """Whether points [N, 3], metres, map frame, of a surface lie where it was continued.

    That is up to ``reach_m`` beside a voxel with seen surface, of which they are in a part that was
    not seen; or so far beside a filled voxel on each axis, at most ``fill_m`` from the voxel with
    seen surface at which that began, and not in a ``FREE`` voxel.
    """
    if fill_m == 0:
        return np.zeros(len(points), np.bool_)
    found = _beside_filled(view, filled, points, reach_m=reach_m, fill_m=fill_m)
    found |= view.status(points, reach_m) == Status.SURFACE
    at = np.flatnonzero(found)
    found[at] = view.status(points[at], 0.0) != Status.FREE
    return found


def _beside_filled(
    view: MapView, filled: FilledVoxels, points: Doubles, reach_m: float, fill_m: float
) -> Bools:
    found = np.zeros(len(points), np.bool_)
    if not len(filled.voxels):
        return found
    places = points / view.voxel_m
    least = filled.voxels.min(axis=0) - 2
    names = cell_names(filled.voxels - least)
    reach, limit = reach_m / view.voxel_m, fill_m / view.voxel_m
    inside = ((places >= least + 1) & (places < filled.voxels.max(axis=0) + 2)).all(axis=1)
    for shift in np.ndindex(2, 2, 2):
        left = np.flatnonzero(inside & ~found)
        beside = np.floor(places[left] + (2 * np.array(shift) - 1) * reach).astype(np.int64)
        rows = _rows(names, cell_names(beside - least))
        near = _box_distances(places[left], filled.sources[rows]) <= limit
        found[left] = (rows >= 0) & near
    return found


def _rows(names: Longs, asked: Longs) -> NDArray[np.intp]:
    """Where each of ``asked`` [N] is among different ``names`` [M]; -1 where it is not."""
    if not len(names):
        return np.full(len(asked), -1, np.intp)
    order = np.argsort(names)
    rows = order[np.minimum(np.searchsorted(names, asked, sorter=order), len(names) - 1)]
    return np.where(names[rows] == asked, rows, -1)


def _middles(voxels: Longs) -> Doubles:
    """The middles [N, 3] of voxels [N, 3], in voxels."""
    return voxels.astype(np.float64) + 0.5


def _box_distances(points: Doubles, voxels: Longs) -> Doubles:
    """Distances [N] of points [N, 3] from voxels [N, 3], in voxels."""
    outside = np.maximum(np.maximum(voxels - points, points - voxels - 1.0), 0.0)
    return np.asarray(np.linalg.norm(outside, axis=1))
