"""The camera of a folder of depth images."""

import json
from pathlib import Path
from typing import NamedTuple

from triquad_client.depth_image import Intrinsics
from triquad_client.errors import NO_NUMBER, InvalidScanError

from triquad_tools.console.command import ToolError

INTRINSICS_NAMES = ("camera_intrinsic.json", "intrinsic.json", "camera_primesense.json")
"""Names that Open3D and its data give them."""


class Camera(NamedTuple):
    """A camera, and the size of its images where that is known."""

    intrinsics: Intrinsics
    shape: tuple[int, ...] | None  # rows and columns
    origin: str  # where this is said, for messages


_TUM = Camera(Intrinsics(525.0, 525.0, 319.5, 239.5), (480, 640), "the documentation of TUM RGB-D")
"""The intrinsics of all three cameras, whose depth was registered by OpenNI:
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats"""


def choose_camera(folder: Path, given: Intrinsics | None) -> Camera:
    """Return the camera that was given, that a folder has in a file, or that its name implies.

    Raises:
        ToolError: it is not known, or the file is not understood.
    """
    if given is not None:
        return Camera(given, None, "--intrinsics")
    for name in INTRINSICS_NAMES:
        if (folder / name).is_file():
            return _read_camera(folder / name)
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


def _read_camera(path: Path) -> Camera:
    """Return the camera of a file as Open3D writes it.

    JSON with ``width``, ``height`` and ``intrinsic_matrix``, nine numbers, column by column.
    """
    try:
        said = json.loads(path.read_text())
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
