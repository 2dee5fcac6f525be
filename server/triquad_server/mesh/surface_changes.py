"""Finds where the surface of a map changed."""

import itertools
import logging
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings, RegionIndex
from triquad_map.compiled.team import Team
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.surface import MARGIN_STEP
from triquad_map.surfels.ray_planes import ShownField
from triquad_map.surfels.surfel_tree import surfel_voxels
from triquad_map.view import REACH_VOXELS

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.epochs.epoch import EpochRegion, FrozenRegion

_log = logging.getLogger(__name__)

_KEY_BITS = 20  # bits of each coordinate of a voxel, or of a group, in its region

_NO_PLACES = np.zeros((0, 3))

_CORNERS = (BLOCK_VOXELS - 1) * np.array(list(itertools.product((0, 1), repeat=3)))
"""The voxels in the corners of a block. No tile is so small that it lies between them."""

_FARTHER = REACH_VOXELS / MARGIN_STEP  # the growth of what was seen of a voxel to be reported


@dataclass(frozen=True)
class Changes:
    """The changes of the surface; positions are metres in the map frame."""

    places: Doubles  # [N, 3] centres of voxels whose surface is new or removed
    drifted: Doubles  # [G, 3] centres of groups whose surface moved as a whole


@dataclass(frozen=True)
class _Voxels:
    """The voxels of a region with seen surface: a map has hundreds of thousands of them."""

    keys: Longs  # [V] increasing; they encode the positions
    margins: NDArray[np.int8]  # [V, 6] quarters of a voxel beyond all ends
    groups: Doubles  # [G, 3] centres of the groups
    group: Ints  # [V] group of each voxel


@dataclass(frozen=True)
class _Recorded:
    """The surface of a region when its changes were last reported."""

    centre: Doubles  # [3] of the region, map frame
    field: ShownField
    evidence: FrozenEvidence
    voxels: _Voxels
    offsets: Floats  # [V] metres from each voxel's centre to the surface
    margins: NDArray[np.int8]  # [V, 6] of the voxels


@dataclass(frozen=True)
class _Stored:
    """A region that is not in memory, when its changes were last reported."""

    region: ColdRegion
    blocks: Longs  # [B, 3] of BLOCK_VOXELS**3 voxels, with seen surface

    @classmethod
    def of(cls, region: ColdRegion) -> "_Stored":
        """Record a region; where it cannot be read, as one without surface."""
        try:
            return cls(region, region.read_evidence().surface_cells())
        except RefusedError as error:
            _log.error("region %s is left out of the tiles: %s", region.index, error)
            return cls(region, np.zeros((0, 3), np.int64))


class SurfaceChanges:
    """Compares each epoch with what was reported before, in groups of voxels: cubes of ``group_m``.

    Where the surface crosses a voxel follows from the field at the voxel's centre, along its
    gradient. While a field is trained, single voxels are never at rest; so a group changes where

    * a voxel with seen surface is new, or forgotten, or was seen half a voxel farther;
    * the surface moved by more than the tolerance in more than half of a group, since it
      was last reported: small movements add up.
    """

    def __init__(
        self, settings: FieldSettings, tolerance_m: float, group_m: float, team: Team
    ) -> None:
        self._settings = settings
        self._tolerance_m = tolerance_m
        self._group_m = group_m
        self._team = team
        self._recorded: dict[RegionIndex, _Recorded | _Stored] = {}

    def since_last(self, regions: tuple[EpochRegion, ...]) -> Iterator[Changes]:
        """Yield what changed since the last call, region by region; take all of it.

        A region that left memory is shown as its parts have it, rounded: all of it changes then,
        and again once it is back.
        """
        before, self._recorded = self._recorded, {}
        for region in regions:
            old = before.pop(region.index, None)
            if isinstance(region, ColdRegion):
                if not (isinstance(old, _Stored) and old.region is region):
                    self._recorded[region.index] = stored = _Stored.of(region)
                    yield from self._all_of(old)
                    yield from self._all_of(stored)
                else:
                    self._recorded[region.index] = old
                continue
            if isinstance(old, _Stored):
                yield from self._all_of(old)
                old = None
            if old and old.field == region.field and old.evidence is region.evidence:
                self._recorded[region.index] = old
            else:
                self._recorded[region.index], changes = self._compare(old, region)
                yield changes
        for gone in before.values():
            yield from self._all_of(gone)

    def _all_of(self, recorded: _Recorded | _Stored | None) -> Iterator[Changes]:
        """Yield all places of a region."""
        if isinstance(recorded, _Recorded):
            yield Changes(self._centres(recorded.centre, recorded.voxels.keys), _NO_PLACES)
        elif recorded is not None:
            corners = (recorded.blocks[:, None] * BLOCK_VOXELS + _CORNERS).reshape(-1, 3)
            yield Changes(self._centres(recorded.region.centre, _key(corners)), _NO_PLACES)

    def _compare(self, old: _Recorded | None, region: FrozenRegion) -> tuple[_Recorded, Changes]:
        """Return what is to be recorded, and what changed; without ``old``, all is new."""
        field, evidence = region.field, region.evidence
        if old is not None and old.evidence is evidence:
            voxels = old.voxels
        else:
            voxels = self._voxels(region.centre, evidence)
        now = self._offsets(region.centre, field, voxels.keys)
        before = np.full(len(voxels.keys), np.nan, np.float32)
        margins, gone = voxels.margins.copy(), np.zeros(0, np.int64)
        if old is not None:
            _, rows, old_rows = np.intersect1d(
                voxels.keys, old.voxels.keys, assume_unique=True, return_indices=True
            )
            before[rows], margins[rows] = old.offsets[old_rows], old.margins[old_rows]
            gone = np.delete(old.voxels.keys, old_rows)
        moved = np.abs(now - before)
        is_new = np.isnan(before)
        is_new |= (np.abs(voxels.margins - margins) >= _FARTHER).any(axis=1)

        def count(chosen: Bools) -> NDArray[np.intp]:
            return np.bincount(voxels.group[chosen], minlength=len(voxels.groups))

        size = np.bincount(voxels.group, minlength=len(voxels.groups))
        drifted = 2 * count(moved > self._tolerance_m) > size
        reported = drifted | (count(is_new) > 0)
        is_reported = reported[voxels.group]
        offsets = np.where(is_reported, now, before)
        margins = np.where(is_reported[:, None], voxels.margins, margins)
        keys = np.concatenate([gone, voxels.keys[is_new]])
        recorded = _Recorded(
            region.centre,
            field,
            evidence,
            voxels,
            offsets=offsets,
            margins=margins,
        )
        return recorded, Changes(self._centres(region.centre, keys), voxels.groups[drifted])

    def _voxels(self, centre: Doubles, evidence: FrozenEvidence) -> _Voxels:
        voxels = _seen_voxels(evidence)
        keys = _key(voxels)
        order = np.argsort(keys)
        keys = keys[order]
        cells = np.floor(self._centres(centre, keys) / self._group_m).astype(np.int64)
        low = cells.min(axis=0, initial=0)
        _, first, group = np.unique(_key(cells - low), return_index=True, return_inverse=True)
        groups = ((cells[first] + 0.5) * self._group_m).astype(np.float64)
        margins = evidence.margins[order].astype(np.int8)
        return _Voxels(keys, margins, groups, group.ravel().astype(np.int32))

    def _centres(self, centre: Doubles, keys: Longs) -> Doubles:
        """Return the centres [N, 3] of voxels of the region at ``centre``, metres, map frame."""
        corner = centre - self._settings.region_side_m / 2
        return corner + (_cells(keys) + 0.5) * self._settings.leaf_m

    def _offsets(self, centre: Doubles, field: ShownField, keys: Longs) -> Floats:
        """Return the distance [V] from voxel centres to the surface, a voxel at most.

        Farther surfaces are in other voxels.
        """
        centres = self._centres(centre, keys)
        offsets = np.empty(len(centres), np.float32)
        leaf_m = self._settings.leaf_m

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            local = (centres[part] - centre).astype(np.float32)
            values = field.evaluate(local, True)
            slope = np.maximum(np.linalg.norm(values.gradient, axis=1), 0.1)
            offsets[part] = np.clip(values.sdf / slope, -leaf_m, leaf_m)

        self._team.split(len(centres), work)
        return offsets


def _seen_voxels(evidence: FrozenEvidence) -> Longs:
    """Return the voxels [V, 3] with seen surface."""
    return surfel_voxels(evidence.cells, evidence.surface, len(evidence.levels))


def _key(cells: Longs) -> Longs:
    """Return one number for each of cells [N, 3], none of them negative."""
    return (cells[:, 0] << 2 * _KEY_BITS) | (cells[:, 1] << _KEY_BITS) | cells[:, 2]


def _cells(keys: Longs) -> Longs:
    """Return the inverse of :func:`_key`."""
    x, y, z = keys >> 2 * _KEY_BITS, keys >> _KEY_BITS, keys
    return np.stack([x, y, z], axis=1) & ((1 << _KEY_BITS) - 1)
