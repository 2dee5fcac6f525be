"""Rigid poses: matrices [4, 4], each a rotation and a translation, from one frame to another."""

import numpy as np

from triquad_format.records.arrays import Doubles

RIGID_TOLERANCE = 1e-3
"""The allowed error of an element of R R^T: files of 6 digits and single precision have it."""

_NEARLY_PARALLEL = 0.9995  # quaternions, of which spherical interpolation would divide by nearly 0


def rotation_error(pose: Doubles) -> float:
    """Return the largest error of an element of R R^T, for the rotation R of a pose [4, 4]."""
    rotation = np.clip(pose[:3, :3], -2, 2)  # no larger number can be part of a rotation
    return float(np.abs(rotation @ rotation.T - np.eye(3)).max())


def is_rotation(pose: Doubles) -> bool:
    """Return whether the upper left of a finite pose [4, 4] is a rotation, within the tolerance."""
    proper = np.linalg.det(np.clip(pose[:3, :3], -2, 2)) > 0
    return bool(proper and rotation_error(pose) <= RIGID_TOLERANCE)


def is_rigid(pose: Doubles) -> bool:
    """Return whether a matrix is a pose [4, 4]: finite, a rotation, the last row 0 0 0 1."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return False
    return is_rotation(pose) and bool((pose[3] == (0, 0, 0, 1)).all())


def moved_pose(pose: Doubles, by: Doubles) -> Doubles:
    """Return a pose [4, 4] whose position is ``by`` [3] off."""
    result: Doubles = pose.copy()
    result[:3, 3] += by
    return result


def upright_pose(x: float, y: float, z: float, yaw_deg: float) -> Doubles:
    """Return the pose [4, 4] of something upright, turned counterclockwise seen from above."""
    yaw, pose = np.radians(yaw_deg), np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, z
    return pose


def orthonormal(pose: Doubles) -> Doubles:
    """Return a rigid pose as a new array, its rotation without the tolerance.

    Raises:
        ValueError: it is not rigid.
    """
    exact = np.array(pose, np.float64)
    if not is_rigid(exact):
        raise ValueError(f"not a rotation and a translation [4, 4]: {exact.tolist()}")
    left, _, right = np.linalg.svd(exact[:3, :3])
    exact[:3, :3] = left @ right
    return exact


def pose_matrices(positions: Doubles, quaternions: Doubles) -> Doubles:
    """Return poses [..., 4, 4] of positions [..., 3] and unit quaternions [..., 4] x, y, z, w.

    Diebel 2006, "Representing attitude", section 5.6.
    """
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    poses = np.zeros((*x.shape, 4, 4))
    poses[..., 0, 0] = 1 - 2 * (y * y + z * z)
    poses[..., 0, 1] = 2 * (x * y - z * w)
    poses[..., 0, 2] = 2 * (x * z + y * w)
    poses[..., 1, 0] = 2 * (x * y + z * w)
    poses[..., 1, 1] = 1 - 2 * (x * x + z * z)
    poses[..., 1, 2] = 2 * (y * z - x * w)
    poses[..., 2, 0] = 2 * (x * z - y * w)
    poses[..., 2, 1] = 2 * (y * z + x * w)
    poses[..., 2, 2] = 1 - 2 * (x * x + y * y)
    poses[..., :3, 3] = positions
    poses[..., 3, 3] = 1.0
    return poses


def quaternion_of(rotation: Doubles) -> Doubles:
    """Return the unit quaternions [..., 4] x, y, z, w of rotations [..., 3, 3].

    Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix".
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(rotation, (-2, -1), (0, 1))
    products = np.zeros((*rotation.shape[:-2], 4, 4))
    products[..., 0, 0] = xx - yy - zz
    products[..., 1, 0], products[..., 1, 1] = yx + xy, yy - xx - zz
    products[..., 2, 0], products[..., 2, 1], products[..., 2, 2] = zx + xz, zy + yz, zz - xx - yy
    products[..., 3, 0], products[..., 3, 1], products[..., 3, 2] = zy - yz, xz - zx, yx - xy
    products[..., 3, 3] = xx + yy + zz
    vectors = np.linalg.eigh(products).eigenvectors  # which reads the lower triangle alone
    return np.asarray(vectors[..., -1], np.float64)


def slerp(first: Doubles, second: Doubles, share: Doubles) -> Doubles:
    """Interpolate between unit quaternions [M, 4], by the shorter way.

    ``share`` [M, 1] is that of the second.
    """
    cosine = (first * second).sum(axis=1, keepdims=True)
    second = np.where(cosine < 0, -second, second)
    cosine = np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, _NEARLY_PARALLEL))
    of_first = np.where(cosine < _NEARLY_PARALLEL, np.sin((1 - share) * angle), 1 - share)
    of_second = np.where(cosine < _NEARLY_PARALLEL, np.sin(share * angle), share)
    between = of_first * first + of_second * second
    return np.asarray(between / np.linalg.norm(between, axis=1, keepdims=True))
