"""Depth images and organised clouds, as the points of a scan and its rays without a return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format.records.arrays import Doubles, Floats

from triquad_client.checks import real_number, real_numbers, whole_number
from triquad_client.errors import NO_NUMBER, InvalidScanError

_MILLIMETRES_PER_M = 1000.0


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: its focal lengths and the middle of its image, pixels.

    The centre of the first pixel lies at 0, 0. The image must be rectified.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        try:
            is_one = np.isfinite(real_numbers(values)).all() and self.fx > 0 and self.fy > 0
        except NO_NUMBER:
            is_one = False
        if not is_one:
            raise InvalidScanError(
                f"intrinsics {values}: fx, fy, cx and cy are finite numbers, the first two above 0"
            )

    @classmethod
    def from_matrix(cls, camera_matrix: ArrayLike) -> Intrinsics:
        """Return those of a camera matrix [3, 3], as OpenCV's ``K`` or the ``k`` of ``CameraInfo``.

        Raises:
            InvalidScanError: it is no such matrix, or has skew.
        """
        try:
            matrix = real_numbers(camera_matrix).astype(np.float64).reshape(3, 3)
        except NO_NUMBER as error:
            raise InvalidScanError(f"the camera matrix is not [3, 3]: {error}") from error
        (fx, skew, cx), (zero, fy, cy), last = matrix
        wrong = f"a skew of {skew:g}, not 0; rectify the images" if skew != 0 else ""
        if zero != 0 or list(last) != [0, 0, 1]:
            wrong = f"the last row {last.tolist()}, not [0, 0, 1]; is it transposed?"
        if wrong:
            raise InvalidScanError(f"the camera matrix {matrix.tolist()} has {wrong}")
        return cls(fx, fy, cx, cy)

    def slopes(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Doubles:
        """Return x and y per metre of depth [2, N] of pixels [N]."""
        slopes: Doubles = np.stack([(columns - self.cx) / self.fx, (rows - self.cy) / self.fy])
        return slopes


def depth_points(
    depth: ArrayLike,
    intrinsics: Intrinsics | ArrayLike,
    stride: int = 1,
    units_per_metre: float | None = None,
) -> Floats:
    """Return the points [N, 3] that a depth image shows, row by row.

    Args:
        depth: [rows, columns] along the optical axis: metres as floating numbers, or millimetres
            as integers without sign (``16UC1``). A pixel that is 0, not finite (REP 117), negative
            or the largest integer shows nothing.
        intrinsics: of the camera; also as a matrix [3, 3]: see :meth:`Intrinsics.from_matrix`.
        stride: every how many rows and columns one is taken.
        units_per_metre: of the depths, where these are no metres or millimetres.

    Returns:
        Metres, in the camera's optical frame: x to the right, y down, z forward.

    Raises:
        InvalidScanError: the image is not one, shows nothing, most of it is negative, or the
            stride is below 1, or the units are none above 0; or the matrix is not that of a camera.
    """
    units = None if units_per_metre is None else _units(units_per_metre)
    image = _metres(depth, units)
    if not isinstance(intrinsics, Intrinsics):
        intrinsics = Intrinsics.from_matrix(intrinsics)
    step = _stride(stride)
    image = image[::step, ::step]
    finite = np.isfinite(image)
    rows, columns = np.nonzero(finite & (image > 0))
    if np.count_nonzero(finite & (image < 0)) > len(rows):
        lowest = image[finite].min()
        raise InvalidScanError(
            f"depth {lowest:g} m is negative, as most: depths lie before the camera"
        )
    if len(rows) == 0:
        raise InvalidScanError("the depth image shows nothing: each pixel is 0 or not finite")
    z = image[rows, columns]
    x, y = intrinsics.slopes(rows * step, columns * step) * z
    return np.stack([x, y, z], axis=1).astype(np.float32)


def _stride(stride: int) -> int:
    try:
        step = whole_number(stride)
    except TypeError:
        step = 0
    if step < 1:
        raise InvalidScanError(f"stride = {stride!r}: use a whole number, 1 or more")
    return step


def _units(units_per_metre: float) -> float:
    try:
        units = real_number(units_per_metre)
    except NO_NUMBER:
        units = 0.0
    if not 0 < units < np.inf:
        raise InvalidScanError(f"units_per_metre = {units_per_metre!r}: use a number above 0")
    return units


def _metres(depth: ArrayLike, units_per_metre: float | None) -> NDArray[np.floating]:
    try:
        image = real_numbers(depth)
    except NO_NUMBER as error:
        raise InvalidScanError(f"depth is not an image of real numbers: {error}") from error
    if image.ndim != 2 or image.size == 0:
        raise InvalidScanError(f"depth is {list(image.shape)}, not [rows, columns]")
    if image.dtype.kind == "f":
        return image if units_per_metre is None else image / np.float32(units_per_metre)
    if image.dtype.kind == "u" and image.dtype.itemsize > 1:
        units = np.float32(units_per_metre or _MILLIMETRES_PER_M)
        metres: NDArray[np.floating] = image / units
        metres[image == np.iinfo(image.dtype).max] = 0.0
        return metres
    raise InvalidScanError(
        f"depth is {image.dtype}: use floating metres, or millimetres as uint16 or uint32"
    )


def empty_returns(cloud: ArrayLike, directions: ArrayLike) -> Doubles:
    """Return the rays of an organised cloud that met nothing, for ``publish_scan(no_return=)``.

    Use it only where the sensor leaves a point empty because its ray met nothing.

    Args:
        cloud: [rows, columns, 3] metres, sensor frame; a point that is empty is NaN or 0 0 0.
        directions: [rows, columns, 3] of the sensor's rays, sensor frame, whatever their length.

    Returns:
        Directions [M, 3] of the empty points, row by row.

    Raises:
        InvalidScanError: the two are not arrays of one shape.
    """
    points, rays = _organised("cloud", cloud), _organised("directions", directions)
    if points.shape != rays.shape:
        raise InvalidScanError(
            f"cloud is {list(points.shape)} and directions are {list(rays.shape)}: give the "
            "direction of each point's ray"
        )
    empty = np.isnan(points).any(axis=-1) | (points == 0).all(axis=-1)
    of_empty: Doubles = rays[empty]
    return of_empty


def _organised(name: str, values: ArrayLike) -> Doubles:
    """Return an array [rows, columns, 3] as float64; values that are not finite may be in it."""
    try:
        array = real_numbers(values).astype(np.float64, copy=False)
    except NO_NUMBER as error:
        raise InvalidScanError(f"{name}: not an array of real numbers: {error}") from error
    if array.ndim != 3 or array.shape[2] != 3:
        raise InvalidScanError(f"{name}: {list(array.shape)} is not [rows, columns, 3]")
    return array
