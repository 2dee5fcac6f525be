"""Where the surface of a map changed: what mesh tiles have to follow."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.field_settings import FieldSettings
from triquad_format.region import RegionIndex
from triquad_kernels.evidence import Evidence

from triquad_server.epoch import FrozenRegion
from triquad_server.threads import Team

_KEY_BITS = 20  # of each coordinate of a voxel in its region


@dataclass(frozen=True)
class _Noted:
    """The surface of a region when its changes were last told."""

    region: FrozenRegion
    keys: NDArray[np.int64]  # [V] of voxels with seen surface, increasing
    centres: NDArray[np.float64]  # [V, 3] metres, map frame
    offsets: NDArray[np.float32]  # [V] metres from each centre to the surface


class SurfaceChanges:
    """Compares each epoch with the one before: which voxels' surface is new, gone or elsewhere.

    Where the surface crosses a voxel is told by the field at the voxel's centre, along its
    gradient. A voxel is told of once it moved by more than the tolerance since it was told of
    last, so that small movements add up.
    """

    def __init__(self, settings: FieldSettings, tolerance_m: float, team: Team) -> None:
        self._settings = settings
        self._tolerance_m = tolerance_m
        self._team = team
        self._noted: dict[RegionIndex, _Noted] = {}

    def since_last(self, regions: tuple[FrozenRegion, ...]) -> NDArray[np.float64]:
        """Centres [N, 3] of the voxels whose surface changed since the last call, map frame."""
        before, self._noted = self._noted, {}
        places = [np.zeros((0, 3))]
        for region in regions:
            old = before.pop(region.index, None)
            if old is None:
                new = self._look(region, None)
                places.append(new.centres)
            elif old.region is region:
                new = old
            else:
                new, changed = self._compare(old, self._look(region, old))
                places.append(changed)
            self._noted[region.index] = new
        places += [gone.centres for gone in before.values()]
        return np.concatenate(places)

    def _compare(self, old: _Noted, new: _Noted) -> tuple[_Noted, NDArray[np.float64]]:
        """What is to be noted, and the places [N, 3] that changed."""
        if new.keys is old.keys:
            before = old.offsets
            gone = np.zeros((0, 3))
        else:
            before = np.full(len(new.keys), np.nan, np.float32)
            rows, found = _find(new.keys, old.keys)
            before[found] = old.offsets[rows[found]]
            _, kept = _find(old.keys, new.keys)
            gone = old.centres[~kept]
        # Written so that NaN, which stands for new voxels, counts as moved.
        stays = np.abs(new.offsets - before) <= self._tolerance_m
        noted = _Noted(new.region, new.keys, new.centres, np.where(stays, before, new.offsets))
        return noted, np.concatenate([gone, new.centres[~stays]])

    def _look(self, region: FrozenRegion, old: _Noted | None) -> _Noted:
        if old is not None and old.region.evidence is region.evidence:
            keys, centres = old.keys, old.centres
        else:
            keys, centres = self._voxels(region.evidence, region.centre)
        return _Noted(region, keys, centres, self._offsets(region, centres))

    def _voxels(
        self, evidence: Evidence, centre: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Keys [V] and centres [V, 3] of the voxels with seen surface."""
        voxels = evidence.surface_voxels()
        keys = (voxels[:, 0] << 2 * _KEY_BITS) | (voxels[:, 1] << _KEY_BITS) | voxels[:, 2]
        order = np.argsort(keys)
        corner = centre - self._settings.region_side_m / 2
        return keys[order], corner + (voxels[order] + 0.5) * self._settings.leaf_m

    def _offsets(self, region: FrozenRegion, centres: NDArray[np.float64]) -> NDArray[np.float32]:
        """How far [V] the surface is from the centres; at most a voxel: beyond are others."""
        offsets = np.empty(len(centres), np.float32)
        leaf_m = self._settings.leaf_m

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            local = (centres[part] - region.centre).astype(np.float32)
            values = region.engine.evaluate(local, True)
            slope = np.maximum(np.linalg.norm(values.gradient, axis=1), 0.1)
            offsets[part] = np.clip(values.sdf / slope, -leaf_m, leaf_m)

        self._team.split(len(centres), work)
        return offsets


def _find(
    keys: NDArray[np.int64], among: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Where increasing keys [N] are among others, and whether they are there at all."""
    rows = np.searchsorted(among, keys)
    if len(among) == 0:
        return rows, np.zeros(len(keys), np.bool_)
    rows = np.minimum(rows, len(among) - 1)
    return rows, among[rows] == keys
