"""Voxels in which rays ended."""

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_server.intake.rays import usable_rays
from triquad_server.settings import Settings
from triquad_tools.sensors.sweep import PosedScan, moved

_KEY_SIDE = 1 << 20  # voxels along an axis that keys can distinguish
NO_VOXEL = -1  # no voxel's key


def end_keys(scan: PosedScan, settings: Settings) -> Longs:
    """Return the keys [N] of the voxels in which the points of a scan lie.

    That of a point is ``NO_VOXEL`` if no ray that a map with such settings uses ends in its voxel.
    """
    pose, leaf_m = scan.world_from_sensor, settings.field.leaf_m
    points = moved(scan.points, pose)
    ends = usable_rays(scan.points.astype(np.float32), pose, settings.scan).ends
    keys = voxel_keys(points, leaf_m)
    return np.where(np.isin(keys, voxel_keys(ends, leaf_m)), keys, NO_VOXEL)


def voxel_keys(points: Doubles, voxel_m: float) -> Longs:
    """Return one number [N] for the voxel of each point [N, 3]."""
    cells = np.floor(points / voxel_m).astype(np.int64) + _KEY_SIDE // 2
    return np.asarray(cells @ np.array([_KEY_SIDE**2, _KEY_SIDE, 1]))


def voxel_centres(keys: Longs, voxel_m: float) -> Doubles:
    """Return the centres [N, 3] of the voxels of keys [N]."""
    cells = np.stack([keys // _KEY_SIDE**2, keys // _KEY_SIDE % _KEY_SIDE, keys % _KEY_SIDE], 1)
    return np.asarray((cells - _KEY_SIDE // 2 + 0.5) * voxel_m)
