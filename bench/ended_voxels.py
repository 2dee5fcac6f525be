"""Voxels in which rays ended."""

from dataclasses import dataclass, field

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_server.intake.rays import usable_rays
from triquad_server.settings import Settings
from triquad_tools.sensors.sweep import PosedScan, moved

_KEY_SIDE = 1 << 20  # voxels along an axis that keys can distinguish
_NONE = -1  # no voxel's key


@dataclass
class EndedVoxels:
    """Voxels in which rays of some scans ended."""

    _scans: list[Longs] = field(default_factory=list)  # the keys of each

    def add(self, keys: Longs) -> None:
        """Add the voxels of a scan: some or all of its :func:`end_keys`."""
        keys = np.unique(keys)
        self._scans.append(keys[keys != _NONE])

    def keys(self, scans: int = 1) -> Longs:
        """Return the keys [N] of those in which rays of at least ``scans`` scans ended."""
        keys, counts = np.unique(np.concatenate(self._scans), return_counts=True)
        return np.asarray(keys[counts >= scans])


def end_keys(scan: PosedScan, settings: Settings) -> Longs:
    """Return the keys [N] of the voxels in which the points of a scan lie.

    A point has none if its voxel contains no end of a ray that a map with such settings uses.
    """
    pose, leaf_m = scan.world_from_sensor, settings.field.leaf_m
    points = moved(scan.points, pose)
    ends = usable_rays(scan.points.astype(np.float32), pose, settings.scan).ends
    keys = voxel_keys(points, leaf_m)
    return np.where(np.isin(keys, voxel_keys(ends, leaf_m)), keys, _NONE)


def voxel_keys(points: Doubles, voxel_m: float) -> Longs:
    """Return one number [N] for the voxel of each point [N, 3]."""
    cells = np.floor(points / voxel_m).astype(np.int64) + _KEY_SIDE // 2
    return np.asarray(cells @ np.array([_KEY_SIDE**2, _KEY_SIDE, 1]))


def voxel_centres(keys: Longs, voxel_m: float) -> Doubles:
    """Return the centres [N, 3] of the voxels of keys [N]."""
    cells = np.stack([keys // _KEY_SIDE**2, keys // _KEY_SIDE % _KEY_SIDE, keys % _KEY_SIDE], 1)
    return np.asarray((cells - _KEY_SIDE // 2 + 0.5) * voxel_m)
