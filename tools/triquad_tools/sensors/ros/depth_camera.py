"""Depth images as ROS has them: ``sensor_msgs/Image`` with its ``CameraInfo``."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from triquad_client.depth_image import Intrinsics, depth_points
from triquad_client.errors import InvalidScanError

from triquad_tools.sensors.ros.header import frame_name, stamp_ns
from triquad_tools.sensors.sweep import NoScanError, Sweep

_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def is_depth(encoding: str) -> bool:
    """Return whether images of this encoding hold depth."""
    return encoding in _ENCODINGS


def camera_topic(image_topic: str) -> str:
    """Return where the ``CameraInfo`` of an image is published: next to it, as usual in ROS."""
    return image_topic.rpartition("/")[0] + "/camera_info"


def intrinsics_of(info: Any) -> Intrinsics:
    """Return the camera of a ``CameraInfo``, for the rectified image.

    Raises:
        NoScanError: it is not calibrated.
    """
    # ROS 1 writes these names in upper case.
    projection = np.asarray(info.p if hasattr(info, "p") else info.P, np.float64).reshape(3, 4)
    matrix = np.asarray(info.k if hasattr(info, "k") else info.K, np.float64).reshape(3, 3)
    if projection[0, 0] > 0:
        matrix = projection[:, :3]
    try:
        return Intrinsics.from_matrix(matrix)
    except InvalidScanError as error:
        raise NoScanError("intrinsics", f"CameraInfo: {error}; calibrate the camera") from error


def sweep_of_depth(image: Any, info: Any, stride: int = 1) -> Sweep:
    """Return the sweep of a depth image, in the camera's optical frame.

    Raises:
        NoScanError: it is no depth image, or does not fit to ``info``.
    """
    if (image.width, image.height) != (info.width, info.height):
        raise NoScanError(
            "intrinsics",
            f"the depth image has {image.width} x {image.height} pixels and its CameraInfo "
            f"{info.width} x {info.height}: use the CameraInfo of the depth camera",
        )
    try:
        points = depth_points(_pixels(image), intrinsics_of(info), stride)
    except InvalidScanError as error:
        raise NoScanError("depth", str(error)) from error
    return Sweep(points, frame_name(image.header.frame_id), stamp_ns(image.header))


def _pixels(image: Any) -> NDArray[Any]:
    """Return a view [rows, columns] of an image."""
    if image.encoding not in _ENCODINGS:
        raise NoScanError(
            "encoding",
            f"the image is {image.encoding}: depth comes as {', '.join(_ENCODINGS)}",
        )
    dtype = np.dtype((">" if image.is_bigendian else "<") + _ENCODINGS[image.encoding])
    step = image.step or image.width * dtype.itemsize
    if image.width * dtype.itemsize > step or image.height * step > len(image.data):
        raise NoScanError(
            "truncated",
            f"the image says {image.height} x {image.width} pixels of {dtype.itemsize} bytes "
            f"in rows of {step}, but has {len(image.data)} bytes",
        )
    shape = (image.height, image.width)
    view: NDArray[Any] = np.ndarray(shape, dtype, image.data, 0, (step, dtype.itemsize))
    return view
