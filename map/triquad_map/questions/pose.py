"""Poses that are moved a little."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles


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
