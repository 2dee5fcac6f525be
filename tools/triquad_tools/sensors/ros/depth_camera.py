"""Depth images as ROS has them: ``sensor_msgs/Image`` with its ``CameraInfo``."""

import re
import struct
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from triquad_client.depth_image import Intrinsics, depth_points
from triquad_client.errors import InvalidScanError

from triquad_tools.sensors.lens import LensCamera, lens_camera
from triquad_tools.sensors.ros.type_store import frame_name, stamp_ns
from triquad_tools.sensors.sweep import NoScanError, Sweep

_FAR_M = 65.5  # as far as depth in millimetres reaches; nearer than 6 cm no camera measures
_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COMPRESSED_HEADER = struct.Struct("<iff")  # of compressedDepth: format, quantisation A and B


def holds_depth(image: Any) -> bool:
    """Return whether an ``Image`` or a ``CompressedImage`` holds depth."""
    return _encoding(image) in _ENCODINGS


def _encoding(image: Any) -> str:
    text = image.format if hasattr(image, "format") else image.encoding
    return str(text).partition(";")[0].strip()


def raw_topic(image_topic: str) -> str:
    """Return the name of an image's topic without that of the way in which it is compressed."""
    return re.sub("/(compressedDepth|compressed)$", "", image_topic)


def camera_topic(image_topic: str) -> str:
    """Return where the ``CameraInfo`` of an image is published: next to it, as usual in ROS."""
    return raw_topic(image_topic).rpartition("/")[0] + "/camera_info"


def camera_of(info: Any, image_topic: str) -> Intrinsics:
    """Return the camera of a ``CameraInfo`` for the images of a topic.

    Those of a topic such as ``image_rect`` are rectified; others have the distortion of the lens.

    Raises:
        NoScanError: it is not calibrated, or its distortion is not understood.
    """
    # ROS 1 writes these names in upper case.
    projection = np.asarray(info.p if hasattr(info, "p") else info.P, np.float64).reshape(3, 4)
    matrix = np.asarray(info.k if hasattr(info, "k") else info.K, np.float64).reshape(3, 3)
    values = tuple(map(float, info.d if hasattr(info, "d") else info.D))
    is_rectified = "rect" in raw_topic(image_topic).rpartition("/")[2]
    if projection[0, 0] > 0 and (is_rectified or matrix[0, 0] == 0):
        matrix = projection[:, :3]
    try:
        camera = Intrinsics.from_matrix(matrix)
    except InvalidScanError as error:
        raise NoScanError("intrinsics", f"CameraInfo: {error}; calibrate the camera") from error
    if is_rectified or not any(values):
        return camera
    return lens_camera(camera, info.distortion_model, values, info.height, info.width)


def sweep_of_depth(
    image: Any, info: Any, topic: str = "", stride: int = 1, units_per_metre: float | None = None
) -> Sweep:
    """Return the sweep of a depth image, compressed or not, in the camera's optical frame.

    Raises:
        NoScanError: it is no depth image, or does not fit to ``info``.
    """
    pixels = _decompressed(image, info) if hasattr(image, "format") else _pixels(image)
    rows, columns = pixels.shape
    _check_size(columns, rows, info)
    camera = camera_of(info, topic)
    try:
        points = depth_points(pixels, camera, stride, units_per_metre)
    except InvalidScanError as error:
        raise NoScanError("depth", str(error)) from error
    far_m = np.nanmedian(points[:, 2]) if len(points) and units_per_metre is None else 0.0
    if far_m > _FAR_M:
        raise NoScanError(
            "depth_units",
            f"half of the depths are more than {far_m:.0f} m: 32FC1 is in metres, 16UC1 in "
            "millimetres (REP 118); of a recording, --units-per-metre 1000 says that they are in "
            "millimetres, and --units-per-metre 1 that they are right",
        )
    note = f"camera {camera_topic(topic)}"
    if isinstance(camera, LensCamera):
        points, note = points[np.isfinite(points).all(axis=1)], f"{note}, {camera.note}"
    return Sweep(points, frame_name(image.header.frame_id), stamp_ns(image.header), note=note)


def _check_size(columns: int, rows: int, info: Any) -> None:
    if (columns, rows) != (info.width, info.height):
        raise NoScanError(
            "intrinsics",
            f"the depth image has {columns} x {rows} pixels and its CameraInfo "
            f"{info.width} x {info.height}: use the CameraInfo of the depth camera",
        )


def _decompressed(image: Any, info: Any) -> NDArray[Any]:
    """Return the pixels [rows, columns] of a PNG, as image_transport compresses depth."""
    from PIL import Image

    encoding, data = _encoding(image), bytes(image.data)
    has_header = "compressedDepth" in image.format
    if encoding not in _ENCODINGS or "rvl" in image.format:
        raise NoScanError(
            "encoding",
            f"the image is {image.format!r}: of compressed ones, depth in PNG is read; record it "
            "so (parameter format: png), or uncompressed by 'image_transport republish'",
        )
    try:
        with Image.open(BytesIO(data[_COMPRESSED_HEADER.size * has_header :])) as picture:
            _check_size(picture.width, picture.height, info)  # before it is unpacked
            pixels = np.asarray(picture).astype(np.uint16)
        _, a, b = _COMPRESSED_HEADER.unpack_from(data) if has_header else (0, 0.0, 0.0)
    except (OSError, ValueError, Image.DecompressionBombError, struct.error) as error:
        raise NoScanError("decode", f"no PNG of depth: {error}") from error
    if encoding != "32FC1":
        return pixels
    with np.errstate(divide="ignore"):  # what is quantised to 0 shows nothing
        return np.where(pixels == 0, np.nan, a / (pixels - b)).astype(np.float32)


def _pixels(image: Any) -> NDArray[Any]:
    if image.encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise NoScanError("encoding", f"the image is {image.encoding}: depth comes as {known}")
    dtype = np.dtype((">" if image.is_bigendian else "<") + _ENCODINGS[image.encoding])
    step = image.step or image.width * dtype.itemsize
    if image.width * dtype.itemsize > step or image.height * step > len(image.data):
        raise NoScanError(
            "truncated",
            f"the image says {image.height} x {image.width} pixels of {dtype.itemsize} bytes "
            f"in rows of {step}, but has {len(image.data)} bytes",
        )
    shape = (image.height, image.width)
    return np.asarray(np.ndarray(shape, dtype, image.data, 0, (step, dtype.itemsize)))
