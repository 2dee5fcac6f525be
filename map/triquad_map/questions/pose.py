"""Rigid poses: matrices [4, 4] that take points of one frame to another."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles

RIGID_TOLERANCE = 1e-3
"""By how much an element of R R^T may be off."""


def is_rigid(pose: Doubles) -> bool:
    """Whether a matrix [4, 4] is a rotation and a translation, and finite."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return False
    rotation = np.clip(pose[:3, :3], -2, 2)  # no larger number can be part of a rotation
    skew = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    proper = skew <= RIGID_TOLERANCE and np.linalg.det(rotation) > 0
    return bool(proper and (pose[3] == (0, 0, 0, 1)).all())


def orthonormal(pose: Doubles) -> Doubles:
    """A rigid pose as a new array, its rotation without the tolerance.

    Raises:
        ValueError: it is not rigid.
    """
    exact = np.array(pose, np.float64)
    if not is_rigid(exact):
        raise ValueError(f"not a rotation and a translation [4, 4]: {exact.tolist()}")
    left, _, right = np.linalg.svd(exact[:3, :3])
    exact[:3, :3] = left @ right
    return exact


def moved(pose: Doubles, translation: Doubles, rotation: Doubles) -> Doubles:
    """A pose moved [3], and turned about itself by a rotation vector [3], both in the map frame."""
    result: Doubles = pose.copy()
    result[:3, :3] = _rotation(rotation) @ pose[:3, :3]
    result[:3, 3] += translation
    return result


def _rotation(vector: Doubles) -> Doubles:
    """The rotation [3, 3] about a vector [3] by its length (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    first = float(np.sinc(angle / math.pi))
    second = 0.5 * float(np.sinc(angle / (2 * math.pi))) ** 2
    rotation: Doubles = np.eye(3) + first * cross + second * (cross @ cross)
    return rotation
