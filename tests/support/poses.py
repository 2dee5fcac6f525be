"""Poses [4, 4] of sensors and robots."""

import numpy as np
from triquad_format.records.arrays import Doubles


def shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Doubles:
    """A pose without rotation."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose
