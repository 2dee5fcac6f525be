"""A pose as a position and a quaternion, the way ROS and trajectory files have it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.records.arrays import Doubles

from triquad_client.errors import NO_NUMBER, InvalidScanError

_UNIT_TOLERANCE = 1e-2
"""By how much a quaternion's length may be off: files of three digits are."""


@dataclass(frozen=True)
class Pose:
    """Where a sensor is and how it is turned, in the map frame: stands for a matrix [4, 4]."""

    position_m: ArrayLike  # [3] x, y, z
    quaternion_xyzw: ArrayLike  # [4] x, y, z, w: the order of ROS; made a unit quaternion

    def matrix(self) -> Doubles:
        """The pose as a matrix [4, 4], ``world_from_sensor``.

        Raises:
            InvalidScanError: it is not 3 and 4 finite numbers, or no rotation.
        """
        pose = np.eye(4)
        pose[:3, :3] = _rotation(_numbers("quaternion_xyzw", self.quaternion_xyzw, 4))
        pose[:3, 3] = _numbers("position_m", self.position_m, 3)
        return pose


def _numbers(name: str, values: ArrayLike, count: int) -> Doubles:
    try:
        array = np.asarray(values, np.float64)
    except NO_NUMBER as error:
        raise InvalidScanError(f"{name} = {values!r} are not {count} numbers: {error}") from error
    if array.shape != (count,):
        raise InvalidScanError(f"{name} is {list(array.shape)}, not [{count}]")
    if not np.isfinite(array).all():
        raise InvalidScanError(f"{name} = {array.tolist()} has values that are not finite")
    return array


def _rotation(quaternion: Doubles) -> Doubles:
    """The rotation [3, 3] of a quaternion x, y, z, w (Diebel 2006, section 5.6)."""
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        raise InvalidScanError(
            f"quaternion_xyzw = {quaternion.tolist()} has the length {length:.4g}, not 1"
        )
    x, y, z, w = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
