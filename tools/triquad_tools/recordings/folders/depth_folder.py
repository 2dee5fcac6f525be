"""Folders of depth images with the poses of the camera, as data sets lay them out."""

import json
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_client.depth_image import Intrinsics, depth_points
from triquad_client.errors import NO_NUMBER, InvalidScanError

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.file_names import in_order
from triquad_tools.recordings.folders.frame_checks import check_rays
from triquad_tools.recordings.folders.scan_folder import (
    PlacedFile,
    ScanFolder,
    checked,
    place_files,
)
from triquad_tools.recordings.recording import ReadingOptions, Stream
from triquad_tools.recordings.text_lines import parse_number, parse_stamps, read_lines
from triquad_tools.sensors.sweep import PosedScan

INTRINSICS_NAMES = ("camera_intrinsic.json", "intrinsic.json", "camera_primesense.json")
"""Names that Open3D and its data give them."""

_REPLICA = "cam_params.json"
_MATRICES = ("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt", "camera-intrinsics.txt")
"""Names of files with a matrix, of ScanNet and of 3DMatch."""

_LIST_NAME = "depth.txt"  # of TUM RGB-D
_TUM_UNITS_PER_M = 5000.0
_LAYOUTS = (
    ("results/depth*.png", 6553.5),  # Replica
    ("depth/*.png", 1000.0),  # Open3D, Redwood, ScanNet
    ("frame-*.depth.png", 1000.0),  # 7-Scenes, 3DMatch
)
"""Where images lie in a folder, and how many units of theirs are a metre."""

_GREY_MODES = ("I;16", "I;16B", "I")  # 16 bits, as versions of Pillow name them


class Camera(NamedTuple):
    """A camera, and the size of its images where that is known."""

    intrinsics: Intrinsics
    shape: tuple[int, ...] | None  # rows and columns
    origin: str  # where this is said, for messages
    units_per_metre: float | None = None  # of its images, where that is said, too


_TUM = Camera(Intrinsics(525.0, 525.0, 319.5, 239.5), (480, 640), "the documentation of TUM RGB-D")
"""The intrinsics of all three cameras, whose depth was registered by OpenNI:
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats"""

_SEVEN_SCENES = Camera(Intrinsics(585.0, 585.0, 320.0, 240.0), (480, 640), "the page of 7-Scenes")
"""The intrinsics of its depth images:
https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/"""


def choose_camera(folder: Path, given: Intrinsics | None) -> Camera:
    """Return the camera that was given, that a folder has in a file, or that its name implies.

    Raises:
        ToolError: it is not known, or the file is not understood.
    """
    if given is not None:
        return Camera(given, None, "--intrinsics")
    for path in (each / name for each in (folder, folder.parent) for name in _MATRICES):
        if path.is_file():
            return _read_matrix(path)
    for name in (*INTRINSICS_NAMES, _REPLICA, f"../{_REPLICA}"):
        if (folder / name).is_file():
            return _read_camera(folder / name)
    if any(folder.glob(_LAYOUTS[-1][0])):
        return _SEVEN_SCENES
    if "freiburg" in folder.resolve().name:
        return _TUM
    raise ToolError(
        f"{folder}: the camera is not known: put {INTRINSICS_NAMES[0]} of Open3D there, or give "
        "--intrinsics FX,FY,CX,CY in pixels"
    )


def check_fits(camera: Camera, shape: tuple[int, ...], path: Path) -> None:
    """Check that an image of these rows and columns fits a camera.

    Raises:
        ToolError: it has another size, or the centre of the camera lies outside of it.
    """
    if camera.shape is not None and camera.shape != shape:
        raise ToolError(
            f"{path}: has {_size(shape)} pixels, and the camera of {camera.origin} "
            f"{_size(camera.shape)}: give the intrinsics for these images, with --intrinsics "
            "FX,FY,CX,CY"
        )
    centre, (rows, columns) = camera.intrinsics, shape
    if not (0 < centre.cx < columns and 0 < centre.cy < rows):
        raise ToolError(
            f"{path}: has {_size(shape)} pixels, and the centre of the camera of {camera.origin} "
            f"lies outside, at {centre.cx:g}, {centre.cy:g}: give the intrinsics for these images"
        )


def _read_matrix(path: Path) -> Camera:
    """Return the camera of a file with a matrix of 3 x 3 or 4 x 4 numbers, row by row."""
    lines = read_lines(path)
    numbers = [parse_number(line.place, word) for line in lines for word in line.words]
    size = {9: 3, 16: 4}.get(len(numbers))
    if size is None:
        raise ToolError(f"{path}: {len(numbers)} numbers, where a camera matrix has 9 or 16")
    try:
        matrix = np.reshape(numbers, (size, size))[:3, :3]
        return Camera(Intrinsics.from_matrix(matrix), None, path.name)
    except InvalidScanError as error:
        raise ToolError(f"{path}: {error}") from error


def _read_camera(path: Path) -> Camera:
    """Return the camera of a file as Open3D writes it, or as Replica has it.

    JSON with ``width``, ``height`` and ``intrinsic_matrix``, nine numbers, column by column; or
    ``camera`` with ``w``, ``h``, ``fx``, ``fy``, ``cx``, ``cy`` and ``scale``, units a metre.
    """
    try:
        said = json.loads(path.read_text("utf-8-sig"))
        if path.name == _REPLICA:
            said = said["camera"]
            intrinsics = Intrinsics(*(float(said[name]) for name in ("fx", "fy", "cx", "cy")))
            shape = int(said["h"]), int(said["w"])
            return Camera(intrinsics, shape, path.name, float(said["scale"]))
        columns = [said["intrinsic_matrix"][start : start + 3] for start in (0, 3, 6)]
        matrix = [list(row) for row in zip(*columns, strict=True)]
        shape = int(said["height"]), int(said["width"])
        return Camera(Intrinsics.from_matrix(matrix), shape, path.name)
    except InvalidScanError as error:
        raise ToolError(f"{path}: {error}; numbers stand column by column") from error
    except (*NO_NUMBER, KeyError) as error:
        raise ToolError(
            f"{path}: has no width, height and intrinsic_matrix of nine numbers, as Open3D writes "
            f"them: {error}"
        ) from error


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"


class _Images(NamedTuple):
    paths: list[Path]
    stamps_ns: list[int] | None  # where a file lists them
    units_per_metre: float


def is_depth_folder(folder: Path) -> bool:
    """Return whether a folder is laid out as one of those that are known."""
    found = (in_order(folder.glob(pattern)) for pattern, _ in _LAYOUTS)
    return (folder / _LIST_NAME).is_file() or any(found)


def read_depth_folder(folder: Path, options: ReadingOptions) -> ScanFolder:
    """Return the depth images of a folder that is laid out so, with their poses.

    An image that shows nothing is a scan without points.

    Raises:
        ToolError: there is no trajectory, no common time or no intrinsics, an image is missing,
            damaged or no depth image, or does not fit to the camera.
    """
    images = _images(folder)
    camera = choose_camera(folder, options.intrinsics)
    placed = place_files(folder, options, images.paths, images.stamps_ns)
    for path, pixels in zip(images.paths, checked(images.paths, read_depth), strict=True):
        check_fits(camera, pixels.shape, path)
    units = options.units_per_metre or camera.units_per_metre or images.units_per_metre
    use = f"scans: {units:g} units a metre, camera of {camera.origin}"
    poses = placed.trajectory
    streams = (
        Stream(f"{images.paths[0].parent.name}/*.png", "depth images", len(placed.files), use),
        Stream(poses.path.name, poses.kind, len(poses.poses), "poses of the camera"),
    )
    read_file = partial(_read_scan, camera, units, options.stride)
    read = ScanFolder(placed.files, read_file, streams, placed.remarks)
    check_rays(read, is_depth=True)
    return read


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Return the pixels [rows, columns] of a depth image, in its own unit.

    Raises:
        ToolError: there is none, it is no PNG of 16 bits a pixel, or it is damaged.
    """
    from PIL import Image

    if not path.is_file():
        raise ToolError(f"{path}: no such file")
    try:
        with Image.open(path, formats=["PNG"]) as image:
            mode, pixels = image.mode, np.asarray(image)
    except Exception as error:  # any error of the library and its codec
        raise ToolError(
            f"{path}: cannot be read as PNG, as depth comes: {error}; copy it again"
        ) from error
    if mode not in _GREY_MODES:
        raise ToolError(
            f"{path}: is an image of mode {mode}: depth takes 16 bits grey; images of colour or "
            "of 8 bits hold none"
        )
    return pixels.astype(np.uint16)


def _read_scan(camera: Camera, units: float, stride: int, file: PlacedFile) -> PosedScan:
    points: NDArray[Any] = np.empty((0, 3), np.float32)
    with suppress(InvalidScanError):  # it shows nothing
        points = depth_points(read_depth(file.path), camera.intrinsics, stride, units)
    return PosedScan(points, file.world_from_sensor)


def _images(folder: Path) -> _Images:
    if not (folder / _LIST_NAME).is_file():
        found = ((in_order(folder.glob(pattern)), units) for pattern, units in _LAYOUTS)
        images, units = next(filter(lambda each: each[0], found))
        return _Images(images, None, units)
    paths: list[Path] = []
    lines = read_lines(folder / _LIST_NAME)
    stamps = parse_stamps(lines)
    for place, text in lines:
        _, *name = text.split(maxsplit=1)
        if not name:
            raise ToolError(f"{place}: {text!r} where a line is the time of an image and its path")
        paths.append(folder / name[0])
        if not paths[-1].is_file():
            raise ToolError(f"{place}: {paths[-1]}: no such file")
    if not paths:
        raise ToolError(f"{folder / _LIST_NAME}: lists no images")
    return _Images(paths, stamps, _TUM_UNITS_PER_M)
