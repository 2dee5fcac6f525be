"""The surfels of a region at one epoch, kept up to date from those of the epoch before.

Surfels stand in the order of the evidence: block by block, and within a block voxel by voxel.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.voxel_index import keys_of
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.surface import (
    HALF_LIFE_S,
    Rows,
    SampleField,
    ShownByRays,
    SurfelKind,
    Surfels,
    fit_surfels,
    nothing_shown,
    support_confidence,
)
from triquad_map.surfels.ray_planes import ray_planes
from triquad_map.surfels.surfel_search import NearestSurfels, find_nearest, no_surfels
from triquad_map.surfels.surfel_tree import SurfelPlaces, SurfelTree, surfel_places, surfel_tree
from triquad_map.view import NO_LENGTH_M, NearestSurface

_RAY_DISC = int(SurfelKind.RAY_DISC)

_NEVER = -1

_FITTED_AT_ONCE = 32_768  # each takes half a kilobyte meanwhile

_AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@kernel()
def _rows_before(before: Bytes, surface: Bytes, count: int) -> Rows:
    """Return the surfel of the same voxel ``before`` of each one [count] now; -1: it had none.

    Their voxels are set in masks [blocks, BLOCK_BYTES]; the blocks are those before and more.
    """
    rows = np.full(count, -1, np.intp)
    new = old = 0
    for block in range(len(surface)):
        for byte in range(BLOCK_BYTES):
            bits = int(surface[block, byte])
            old_bits = int(before[block, byte]) if block < len(before) else 0
            if bits | old_bits == 0:  # as in most blocks, which are of open air
                continue
            for z in range(BLOCK_VOXELS):
                if bits >> z & old_bits >> z & 1:
                    rows[new] = old
                new += bits >> z & 1
                old += old_bits >> z & 1
    return rows


class RegionFrame(NamedTuple):
    """The place of a region's leaf coordinates in the map, and the time of the query."""

    corner: tuple[float, float, float]  # where they are 0, metres, map frame
    leaf_m: float
    newest_s: int  # when anything in the map was seen last, seconds since 1970


class ShownSurfels(NamedTuple):
    """The properties of surfels that were found."""

    kinds: Bytes  # [S]
    normals: Floats  # [S, 3]
    confidence: Floats  # [S]
    seen_s: Longs  # [S]


@inner_kernel()
def _write(
    i: int, place: Doubles, found: NearestSurfels, frame: RegionFrame, nearest: NearestSurface
) -> None:
    """Write where the surface lies that was found for point ``i``, and which way it is."""
    nearest.found[i] = True
    nearest.distance[i] = found.distances[i] * frame.leaf_m
    square = 0.0
    for axis in range(3):
        nearest.point[i, axis] = found.closest[i, axis] * frame.leaf_m + frame.corner[axis]
        away = place[axis] - found.means[i, axis]
        nearest.gradient[i, axis] = away
        square += away * away
    length = np.sqrt(square)
    for axis in range(3):
        if length * frame.leaf_m > NO_LENGTH_M:
            nearest.gradient[i, axis] /= length
        else:
            nearest.gradient[i, axis] = 0.0


@kernel()
def improve_nearest(
    points: Doubles,
    tree: SurfelTree,
    shown: ShownSurfels,
    frame: RegionFrame,
    nearest: NearestSurface,
) -> None:
    """Improve ``nearest`` where a surfel lies nearer to ``points`` [N, 3] of the map frame."""
    places = (points - np.array(frame.corner)) / frame.leaf_m
    found = no_surfels(nearest.distance / frame.leaf_m)
    find_nearest(places, tree, found)
    for i in range(len(points)):
        row = found.rows[i]
        if row < 0:
            continue
        _write(i, places[i], found, frame, nearest)
        age_s = max(frame.newest_s - shown.seen_s[row], 0)
        nearest.confidence[i] = shown.confidence[row] * np.exp2(-age_s / HALF_LIFE_S)
        nearest.learnt[i] = shown.kinds[row] < _RAY_DISC
        for axis in range(3):
            is_facing = shown.kinds[row] == _RAY_DISC
            nearest.normal[i, axis] = shown.normals[row, axis] if is_facing else np.float32(0)


@dataclass(frozen=True)
class _Fitted:
    """Surfels in their places, and the epoch in which each was fitted last."""

    places: SurfelPlaces
    surfels: Surfels
    epochs: Longs  # [S] ``_NEVER`` where there is nothing yet

    def fit(
        self,
        rows: Rows,
        voxels: Longs,
        evidence: FrozenEvidence,
        field: SampleField,
        by_rays: ShownByRays,
    ) -> None:
        """Fit the surfels in ``rows`` [R], of ``voxels`` [R, 3], to a field."""
        for first in range(0, len(rows), _FITTED_AT_ONCE):
            part = slice(first, first + _FITTED_AT_ONCE)
            found = fit_surfels(voxels[part], field, evidence.ended_in, by_rays)
            self.surfels.take(rows[part], found)


class SurfelMap:
    """Immutable: epochs share it."""

    def __init__(self, evidence: FrozenEvidence, fitted: _Fitted, voxels: Longs) -> None:
        """Use :func:`first_surfels` or :meth:`updated`; ``voxels`` [S, 3] are the surfels'."""
        self._fitted = fitted
        places = fitted.places
        self._tree = surfel_tree(places.shape, voxels, fitted.surfels)
        kinds = fitted.surfels.kinds
        self.planes = ray_planes(evidence, places.starts, fitted.surfels)
        self._shown = ShownSurfels(
            kinds,
            normals=fitted.surfels.normals,
            confidence=support_confidence(evidence.levels, kinds),
            seen_s=np.repeat(evidence.seen_s, np.diff(places.starts)),
        )

    def __len__(self) -> int:
        return len(self._fitted.epochs)

    def voxels(self) -> Longs:
        """Return the voxel [S, 3] of each surfel."""
        return self._fitted.places.voxels()

    @property
    def surfels(self) -> Surfels:
        """The surfels, in the order of their voxels."""
        return self._fitted.surfels

    def find_nearest(self, points: Doubles, found: NearestSurfels) -> None:
        """Improve ``found`` where a surfel lies nearer to leaf coordinates ``points`` [N, 3]."""
        find_nearest(points, self._tree, found)

    def improve(self, nearest: NearestSurface, points: Doubles, frame: RegionFrame) -> None:
        """Improve ``nearest`` where a surfel lies nearer to ``points`` [N, 3] of the map frame."""
        improve_nearest(points, self._tree, self._shown, frame, nearest)

    def updated(
        self,
        evidence: FrozenEvidence,
        field: SampleField,
        epoch: int,
        most: int | None,
        by_rays: ShownByRays = nothing_shown,
        since: int = 0,
    ) -> "SurfelMap":
        """Return the surfels of a later epoch: new ones are fitted, and of the others the oldest.

        At most ``most`` are fitted of those that rays alone show, and of the rest; ``None``: all.
        Those that rays alone show follow what ended there from the scan ``since`` on.
        """
        places = self._fitted.places
        if not np.array_equal(places.surface, evidence.surface):
            places = surfel_places(evidence.cells, evidence.surface)
        voxels = places.voxels()
        fitted = _carried(self._fitted, places, voxels)
        rows = _outdated(fitted, most)
        _follow_rays(fitted.surfels, voxels, rows, by_rays, since)
        fitted.fit(rows, voxels[rows], evidence, field, by_rays)
        fitted.epochs[rows] = epoch
        return SurfelMap(evidence, fitted, voxels)


def first_surfels(
    evidence: FrozenEvidence,
    field: SampleField,
    epoch: int,
    by_rays: ShownByRays = nothing_shown,
    around: FrozenEvidence | None = None,
) -> SurfelMap:
    """Return the surfels of all seen voxels, for an epoch.

    The evidence may be a part of what is ``around``.
    """
    fitted = _nothing_in(surfel_places(evidence.cells, evidence.surface))
    voxels = fitted.places.voxels()
    fitted.fit(np.arange(len(voxels)), voxels, around or evidence, field, by_rays)
    fitted.epochs[:] = epoch
    return SurfelMap(evidence, fitted, voxels)


def _nothing_in(places: SurfelPlaces) -> _Fitted:
    count = int(places.starts[-1])
    return _Fitted(places, Surfels.none(count), np.full(count, _NEVER, np.int64))


def _carried(before: _Fitted, places: SurfelPlaces, voxels: Longs) -> _Fitted:
    """Return copies of surfels in later ``places``, which are of ``voxels`` [S, 3]."""
    if places is before.places:
        every = np.arange(len(before.epochs))
        return _Fitted(places, before.surfels.chosen(every), before.epochs.copy())
    if not len(before.epochs):
        return _nothing_in(places)
    found = _rows_before(before.places.surface, places.surface, len(voxels))
    new = np.flatnonzero(found < 0)
    after = _Fitted(places, before.surfels.chosen(found), before.epochs[found])
    after.surfels.take(new, Surfels.none(len(new)))
    after.epochs[new] = _NEVER
    if len(voxels) - len(new) < len(before.epochs):
        gone = np.delete(before.places.voxels(), found[found >= 0], axis=0)
        after.epochs[_beside(after.surfels, voxels, gone)] = _NEVER
    return after


def _beside(surfels: Surfels, voxels: Longs, gone: Longs) -> Rows:
    """Return surfels of ``voxels`` [S, 3] whose surface may have lain in ``gone`` [N, 3] nearby."""
    rows = np.flatnonzero(surfels.kinds == SurfelKind.NONE)
    around = (gone[:, None] + _AROUND).reshape(-1, 3)
    return rows[np.isin(keys_of(voxels[rows]), keys_of(around))]


def _follow_rays(
    surfels: Surfels, voxels: Longs, fitted: Rows, by_rays: ShownByRays, since: int
) -> None:
    """Let those that rays alone show follow what ended ``since`` a scan, unless they are fitted."""
    followed = surfels.are_unlearnt
    followed[fitted] = False
    rows = np.flatnonzero(followed)
    shown = by_rays(voxels[rows], since)
    known = np.flatnonzero(shown.kinds != SurfelKind.NONE)
    surfels.take(rows[known], shown.chosen(known))


def _outdated(fitted: _Fitted, most: int | None) -> Rows:
    """Return what was never fitted, and at most ``most`` of the rest, those longest ago.

    At most as many more are what the field has still to learn: further rays show it better, and
    the field takes over soon after it has learnt it.
    """
    if most is None:
        return np.arange(len(fitted.epochs))
    never = fitted.epochs == _NEVER
    unlearnt = ~never & fitted.surfels.are_unlearnt
    groups = [_oldest(fitted, group, most) for group in (unlearnt, ~never & ~unlearnt)]
    return np.concatenate([np.flatnonzero(never), *groups])


def _oldest(fitted: _Fitted, chosen: Bools, most: int) -> Rows:
    """Return at most ``most`` of the ``chosen`` [S] surfels, those that were fitted longest ago."""
    rows = np.flatnonzero(chosen)
    if len(rows) <= most:
        return rows
    return rows[np.argpartition(fitted.epochs[rows], most)[:most]]
