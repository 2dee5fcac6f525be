"""A pose as a position and a quaternion, the way ROS and trajectory files have it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import RIGID_TOLERANCE, is_rotation, pose_matrices, rotation_error

from triquad_client.checks import real_numbers
from triquad_client.errors import NO_NUMBER, InvalidScanError

UNIT_TOLERANCE = 1e-2
"""The allowed error of a quaternion's length: files of three digits have it."""


@dataclass(frozen=True)
class Pose:
    """The place and rotation of a sensor in the map frame: it stands for a matrix [4, 4]."""

    position_m: ArrayLike  # [3] x, y, z
    quaternion_xyzw: ArrayLike  # [4] x, y, z, w: the order of ROS; made a unit quaternion

    def matrix(self) -> Doubles:
        """Return the pose as a matrix [4, 4], ``world_from_sensor``.

        Raises:
            InvalidScanError: it is not 3 and 4 finite numbers, or no rotation.
        """
        return pose_matrices(*self.numbers())

    def numbers(self) -> tuple[Doubles, Doubles]:
        """Return the position [3] and the unit quaternion [4].

        Raises:
            InvalidScanError: as :meth:`matrix`.
        """
        position = _numbers("position_m", self.position_m, 3)
        quaternion = _numbers("quaternion_xyzw", self.quaternion_xyzw, 4)
        with np.errstate(over="ignore"):  # what overflows has no length of 1
            length = float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > UNIT_TOLERANCE:
            raise InvalidScanError(
                f"quaternion_xyzw = {quaternion.tolist()} has the length {length:.4g}, not 1"
            )
        return position, quaternion / length


PoseLike: TypeAlias = ArrayLike | Pose
"""A rigid pose in the map frame: a matrix [4, 4], or a position and a quaternion."""


def rigid_pose(world_from_sensor: PoseLike) -> Doubles:
    """Return a pose [4, 4] as float64: a rotation and a translation, within 1e-3."""
    if isinstance(world_from_sensor, Pose):
        return world_from_sensor.matrix()
    try:
        pose = real_numbers(world_from_sensor).astype(np.float64)
    except NO_NUMBER as error:
        raise InvalidScanError(f"world_from_sensor is not a matrix: {error}") from error
    if pose.shape != (4, 4):
        raise InvalidScanError(f"world_from_sensor is {list(pose.shape)}, not [4, 4]")
    if not np.isfinite(pose).all():
        raise InvalidScanError(f"world_from_sensor has values that are not finite:\n{pose}")
    if not is_rotation(pose):
        raise InvalidScanError(
            f"world_from_sensor is not rigid: R R^T is off by {rotation_error(pose):.2g}, "
            f"det R = {np.linalg.det(pose[:3, :3]):.3g}; remove scale, shear and mirroring"
        )
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID_TOLERANCE:
        raise InvalidScanError(
            f"the last row of world_from_sensor is {pose[3]}, not 0 0 0 1; is it transposed?"
        )
    pose[3] = (0, 0, 0, 1)
    return pose


def _numbers(name: str, values: ArrayLike, count: int) -> Doubles:
    try:
        array = real_numbers(values).astype(np.float64)
    except NO_NUMBER as error:
        raise InvalidScanError(f"{name} = {values!r} are not {count} numbers: {error}") from error
    if array.shape != (count,):
        raise InvalidScanError(f"{name} is {list(array.shape)}, not [{count}]")
    if not np.isfinite(array).all():
        raise InvalidScanError(f"{name} = {array.tolist()} has values that are not finite")
    return array
