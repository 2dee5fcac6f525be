"""Rigid poses."""

import numpy as np
from numpy.typing import NDArray

RIGID_TOLERANCE = 1e-3


def is_rigid(pose: NDArray[np.float64]) -> bool:
    """Whether a matrix [4, 4] is a rotation and a translation, and finite."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return False
    rotation = np.clip(pose[:3, :3], -2, 2)  # no larger number can be part of a rotation
    skew = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    proper = skew <= RIGID_TOLERANCE and np.linalg.det(rotation) > 0
    return bool(proper and (pose[3] == (0, 0, 0, 1)).all())
