"""The surfels of a region at one epoch, kept up to date from those of the epoch before.

Surfels stand in the order of the evidence: block by block, and within a block voxel by voxel.
"""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import BLOCK_BYTES, surface_counts

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, keys_of
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import FieldValues, FrozenField, in_grid
from triquad_map.surface import (
    Rows,
    SampleField,
    ShownByRays,
    SurfelKind,
    Surfels,
    fit_surfels,
    nothing_shown,
    support_confidence,
)
from triquad_map.surfels.nearest_surface import RegionFrame, ShownSurfels, improve_nearest
from triquad_map.surfels.ray_planes import put_planes, ray_planes
from triquad_map.surfels.surfel_search import NearestSurfels, find_nearest
from triquad_map.surfels.surfel_tree import TreeShape, surfel_tree, tree_shape
from triquad_map.view import NearestSurface

_NEVER = -1

_FITTED_AT_ONCE = 32_768  # each takes half a kilobyte meanwhile

_AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class SurfelPlaces:
    """The places of the surfels of the voxels in which rays ended."""

    cells: Longs  # [blocks, 3]
    surface: Bytes  # [blocks, BLOCK_BYTES] these voxels
    starts: Ints  # [blocks + 1] first surfel of each block
    shape: TreeShape

    def voxels(self) -> Longs:
        """Return the voxel [S, 3] of each surfel, not kept: it takes a quarter of the memory."""
        used = np.flatnonzero(np.diff(self.starts))  # most blocks are of open air
        return surfel_voxels(self.cells[used], self.surface[used], int(self.starts[-1]))


def surfel_places(cells: Longs, surface: Bytes) -> SurfelPlaces:
    """Return places for voxels in ``surface`` [blocks, BLOCK_BYTES] of blocks ``cells`` [, 3]."""
    starts = np.append(0, np.cumsum(surface_counts(surface))).astype(np.int32)
    shape = tree_shape(surfel_voxels(cells, surface, int(starts[-1])))
    return SurfelPlaces(cells, surface, starts, shape)


@kernel()
def surfel_voxels(cells: Longs, surface: Bytes, count: int) -> Longs:
    """Return the voxels [count, 3] of surfels, given the blocks' ``cells`` [blocks, 3]."""
    voxels = np.empty((count, 3), np.int64)
    at = 0
    for row in range(len(surface)):
        for byte in range(BLOCK_BYTES):
            bits = int(surface[row, byte])
            if bits == 0:  # as in most blocks, which are of open air
                continue
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    voxels[at, 0] = (cells[row, 0] << SHIFT) + (byte >> SHIFT)
                    voxels[at, 1] = (cells[row, 1] << SHIFT) + (byte & LOW)
                    voxels[at, 2] = (cells[row, 2] << SHIFT) + z
                    at += 1
    return voxels


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
        self._planes = ray_planes(evidence, places.starts, fitted.surfels)
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

    @property
    def are_learnt(self) -> bool:
        """Whether the field has learnt all of them: then :meth:`put_planes` changes nothing."""
        return self._planes is None

    def put_planes(
        self, settings: FieldSettings, points: Floats, sdf: Floats, gradients: Floats
    ) -> None:
        """Correct what a field says where it has not learnt the surface; :func:`put_planes`."""
        if self._planes is not None:
            middle = float(1 << (settings.depth - 1))
            put_planes(points, settings.leaf_m, middle, self._planes, sdf, gradients)

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


@dataclass(frozen=True)
class ShownField:
    """A trained field, and near surface that it has not learnt, the planes that rays have shown."""

    trained: FrozenField
    surfels: SurfelMap

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """Return the field at points [N, 3], on the caller's thread."""
        values = self.trained.evaluate(points, gradient)
        self.surfels.put_planes(self.trained.settings, points, values.sdf, values.gradient)
        return values

    def evaluate_in_grid(self, axes: Floats, points: Longs) -> Floats:
        """Return distances [N] at points of a grid: :meth:`FrozenField.evaluate_in_grid`."""
        distances = self.trained.evaluate_in_grid(axes, points)
        if not self.surfels.are_learnt:
            places, gradients = in_grid(axes, points), np.zeros((0, 3), np.float32)
            self.surfels.put_planes(self.trained.settings, places, distances, gradients)
        return distances


def first_surfels(
    evidence: FrozenEvidence, field: SampleField, epoch: int, by_rays: ShownByRays = nothing_shown
) -> SurfelMap:
    """Return the surfels of all seen voxels, for an epoch."""
    fitted = _nothing_in(surfel_places(evidence.cells, evidence.surface))
    voxels = fitted.places.voxels()
    fitted.fit(np.arange(len(voxels)), voxels, evidence, field, by_rays)
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
