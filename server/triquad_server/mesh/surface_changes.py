"""Finds where the surface of a map changed, and which mesh tiles are out of date by it."""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_map.compiled.team import Team
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.mesh.tile_mesh import TileBorder, TileIndex, TileLattice
from triquad_map.surface import MARGIN_STEP
from triquad_map.surfels.ray_planes import ShownField
from triquad_map.surfels.surfel_tree import surfel_voxels
from triquad_map.view import REACH_VOXELS

from triquad_server.epochs.epoch import FrozenRegion

_AROUND = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]

_KEY_BITS = 20  # bits of each coordinate of a voxel, or of a group, in its region

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
        self._recorded: dict[RegionIndex, _Recorded] = {}

    def since_last(self, regions: tuple[FrozenRegion, ...]) -> Changes:
        """Return what changed since the last call."""
        before, self._recorded = self._recorded, {}
        nothing = np.zeros((0, 3))
        found = [Changes(nothing, nothing)]
        for region in regions:
            old = before.pop(region.index, None)
            if old and old.field == region.field and old.evidence is region.evidence:
                self._recorded[region.index] = old
            else:
                self._recorded[region.index], changes = self._compare(old, region)
                found.append(changes)
        for gone in before.values():
            found.append(Changes(self._centres(gone.centre, gone.voxels.keys), nothing))
        return Changes(
            np.concatenate([changes.places for changes in found]),
            np.concatenate([changes.drifted for changes in found]),
        )

    def _compare(self, old: _Recorded | None, region: FrozenRegion) -> tuple[_Recorded, Changes]:
        """Return what is to be recorded, and what changed; without ``old``, all is new."""
        if old is not None and old.evidence is region.evidence:
            voxels = old.voxels
        else:
            voxels = self._voxels(region)
        now = self._offsets(region, voxels.keys)
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
            region.field,
            region.evidence,
            voxels,
            offsets=offsets,
            margins=margins,
        )
        return recorded, Changes(self._centres(region.centre, keys), voxels.groups[drifted])

    def _voxels(self, region: FrozenRegion) -> _Voxels:
        evidence = region.evidence
        voxels = surfel_voxels(evidence.cells, evidence.surface, len(region.surfels))
        keys = _key(voxels)
        order = np.argsort(keys)
        keys = keys[order]
        cells = np.floor(self._centres(region.centre, keys) / self._group_m).astype(np.int64)
        low = cells.min(axis=0, initial=0)
        _, first, group = np.unique(_key(cells - low), return_index=True, return_inverse=True)
        groups = ((cells[first] + 0.5) * self._group_m).astype(np.float64)
        margins = evidence.margins[order].astype(np.int8)
        return _Voxels(keys, margins, groups, group.ravel().astype(np.int32))

    def _centres(self, centre: Doubles, keys: Longs) -> Doubles:
        """Return the centres [N, 3] of voxels of the region at ``centre``, metres, map frame."""
        corner = centre - self._settings.region_side_m / 2
        return corner + (_cells(keys) + 0.5) * self._settings.leaf_m

    def _offsets(self, region: FrozenRegion, keys: Longs) -> Floats:
        """Return the distance [V] from voxel centres to the surface, a voxel at most.

        Farther surfaces are in other voxels.
        """
        centres = self._centres(region.centre, keys)
        offsets = np.empty(len(centres), np.float32)
        leaf_m = self._settings.leaf_m

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            local = (centres[part] - region.centre).astype(np.float32)
            values = region.field.evaluate(local, True)
            slope = np.maximum(np.linalg.norm(values.gradient, axis=1), 0.1)
            offsets[part] = np.clip(values.sdf / slope, -leaf_m, leaf_m)

        self._team.split(len(centres), work)
        return offsets


@dataclass(frozen=True)
class CachedTile:
    """A tile that was made; its bytes may be dropped, what neighbours need of it never is."""

    made: int  # epoch of which it is
    empty: bool  # without faces
    border: TileBorder


class TileChange(NamedTuple):
    """When the surface of a tile changed last."""

    epoch: int
    revision: int  # its number among all changes of the level: there are several in an epoch


_NEVER = TileChange(0, 0)


class TileLevel:
    """Keeps the tiles of one level of detail, and when the surface of each changed."""

    def __init__(self, lattice: TileLattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, CachedTile] = {}  # as they were last made
        self.changed: dict[TileIndex, TileChange] = {}  # the last one of each
        self.revision = 0  # number of the newest change

    def clean(self, index: TileIndex) -> CachedTile | None:
        """Return the tile if it shows the current surface; None if it has to be made."""
        tile = self.tiles.get(index)
        return None if tile is None or tile.made < self.changed.get(index, _NEVER).epoch else tile

    def touch(self, index: TileIndex, epoch: int) -> None:
        """Record that the surface of a tile changed in ``epoch``."""
        self.changed.pop(index, None)
        self.revision += 1
        self.changed[index] = TileChange(epoch, self.revision)  # the newest is last

    def record(self, changes: Changes, half_m: float, epoch: int) -> None:
        """Record what changed in ``epoch``; voxels have sides of twice ``half_m``."""
        low, high = changes.places - half_m, changes.places + half_m
        touched = [
            *self.lattice.tiles_meeting(low, high, self.lattice.margin_m).tolist(),
            *self.lattice.tiles_meeting(changes.drifted, changes.drifted).tolist(),
        ]
        for x, y, z in touched:
            self.touch((x, y, z), epoch)

    def changed_since(self, low: Doubles, high: Doubles, since: int) -> dict[TileIndex, int]:
        """Return the epoch in which the surface of each tile changed, after revision ``since``.

        They meet a box with the corners ``low`` and ``high`` [3], metres, map frame. Since 0,
        those that are known to have no faces are left out.
        """
        newest_first = itertools.takewhile(
            lambda index: self.changed[index].revision > since, reversed(self.changed)
        )
        found = [index for index in newest_first if since or not self._is_empty(index)]
        inside = self.lattice.meets(np.array(found, np.int64).reshape(-1, 3), low, high)
        return {index: self.changed[index].epoch for index in itertools.compress(found, inside)}

    def _is_empty(self, index: TileIndex) -> bool:
        tile = self.clean(index)
        return tile is not None and tile.empty

    def borders_around(self, index: TileIndex) -> dict[TileIndex, TileBorder]:
        """Return the borders with which a tile has to agree, by their tiles, in its own lattice.

        That is its own border if only its bytes were dropped, and those of all neighbours that show
        the current surface: these agree with each other. The others will be made to fit it.
        """
        found: dict[TileIndex, TileBorder] = {}
        own = self.clean(index)
        if own is not None:
            found[index] = own.border
        for offset in _AROUND:
            x, y, z = (a + b for a, b in zip(index, offset, strict=True))
            neighbour = self.clean((x, y, z))
            if neighbour is not None:
                found[x, y, z] = neighbour.border.seen_from(offset, self.lattice.cells)
        return found


def _key(cells: Longs) -> Longs:
    """Return one number for each of cells [N, 3], none of them negative."""
    return (cells[:, 0] << 2 * _KEY_BITS) | (cells[:, 1] << _KEY_BITS) | cells[:, 2]


def _cells(keys: Longs) -> Longs:
    """Return the inverse of :func:`_key`."""
    x, y, z = keys >> 2 * _KEY_BITS, keys >> _KEY_BITS, keys
    return np.stack([x, y, z], axis=1) & ((1 << _KEY_BITS) - 1)
