"""Folders of depth images with a trajectory of the camera: those of TUM RGB-D, and of Open3D."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from triquad_client.depth_image import Intrinsics, depth_points

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.camera import Camera, check_fits, choose_camera
from triquad_tools.recordings.folders.depth_png import check_depth, read_depth
from triquad_tools.recordings.folders.file_names import in_order
from triquad_tools.recordings.folders.placed_files import (
    PlacedFiles,
    choose_trajectory,
    look_through,
    place_by_time,
    place_files,
)
from triquad_tools.recordings.folders.trajectory import Trajectory, read_trajectory
from triquad_tools.recordings.recording import ScanEntry, Stream
from triquad_tools.recordings.text_lines import parse_stamp, read_lines
from triquad_tools.sensors.sweep import PosedScan

_LIST_NAME = "depth.txt"  # of TUM RGB-D
_FOLDER_NAME = "depth"  # of Open3D
_TUM_UNITS_PER_M, _OPEN3D_UNITS_PER_M = 5000.0, 1000.0


@dataclass(frozen=True)
class DepthOptions:
    """The options for reading a folder of depth images."""

    trajectory: Path | None = None  # the file of poses; else that with a usual name
    intrinsics: Intrinsics | None = None  # else those of a file in the folder
    units_per_metre: float | None = None  # of a pixel; else 5000 for TUM RGB-D, 1000 for others
    stride: int = 1  # take every N-th row and column

    def __post_init__(self) -> None:
        units = self.units_per_metre
        if units is not None and not (math.isfinite(units) and units > 0):
            raise ToolError(f"{units} units a metre: use a number above 0, such as 1000")
        if self.stride < 1:
            raise ToolError(f"a stride of {self.stride}: use 1 or more")


@dataclass(frozen=True)
class DepthFolder:
    """The depth images of a folder with their poses; pixels are read when asked for."""

    placed: PlacedFiles
    trajectory: Trajectory
    camera: Camera
    units_per_metre: float
    stride: int

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The images that have a pose."""
        return self.placed.entries

    @property
    def streams(self) -> Sequence[Stream]:
        """The images and the trajectory."""
        images = self.placed.files[0].path.parent.name + "/*.png"
        use = f"scans: {self.units_per_metre:g} units a metre, camera of {self.camera.origin}"
        poses = self.trajectory
        return [
            Stream(images, "depth images", len(self.placed.files), frame="", use=use),
            Stream(poses.path.name, poses.kind, len(poses), frame="", use="poses of the camera"),
        ]

    @property
    def remarks(self) -> Sequence[str]:
        """The remarks on images without a pose, and on files that were not used."""
        return self.placed.remarks

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers; one without points where an image shows nothing."""
        for index in indices:
            file = self.placed.files[index]
            pixels = read_depth(file.path)
            points = np.empty((0, 3), np.float32)
            if pixels[:: self.stride, :: self.stride].any():
                metres = pixels / np.float32(self.units_per_metre)
                points = depth_points(metres, self.camera.intrinsics, self.stride)
            yield PosedScan(points, file.world_from_sensor)


def is_depth_folder(folder: Path) -> bool:
    """Return whether a folder is laid out as those of TUM RGB-D or of Open3D are."""
    return (folder / _LIST_NAME).is_file() or any((folder / _FOLDER_NAME).glob("*.png"))


def read_depth_folder(folder: Path, options: DepthOptions | None = None) -> DepthFolder:
    """Return the depth images of a folder with their poses.

    Raises:
        ToolError: there are no images, no trajectory, no common times or no intrinsics, an
            image is damaged or no depth image, or does not fit to the camera.
    """
    options = options or DepthOptions()
    if not folder.is_dir():
        raise ToolError(f"{folder}: no such folder")
    images = _listed(folder) if (folder / _LIST_NAME).is_file() else _found(folder)
    camera = choose_camera(folder, options.intrinsics)
    chosen = choose_trajectory(folder, options.trajectory)
    trajectory = read_trajectory(chosen.path)
    for path, size in zip(images.paths, look_through(images.paths, check_depth), strict=True):
        check_fits(camera, size, path)
    if images.stamps_ns is None:
        placed = place_files(images.paths, trajectory)
    else:
        placed = place_by_time(images.paths, images.stamps_ns, trajectory)
    return DepthFolder(
        placed.with_remarks(chosen.remarks),
        trajectory,
        camera=camera,
        units_per_metre=options.units_per_metre or images.units_per_metre,
        stride=options.stride,
    )


class _Images(NamedTuple):
    paths: list[Path]
    stamps_ns: list[int] | None  # where a file lists them
    units_per_metre: float


def _listed(folder: Path) -> _Images:
    """Return the images that TUM lists: a line for each, its time and its path."""
    paths: list[Path] = []
    stamps: list[int] = []
    for place, text in read_lines(folder / _LIST_NAME):
        stamp, *name = text.split(maxsplit=1)
        if not name:
            raise ToolError(f"{place}: {text!r} where a line is the time of an image and its path")
        stamps.append(parse_stamp(place, stamp, stamps[-1] if stamps else 0))
        paths.append(folder / name[0])
        if not paths[-1].is_file():
            raise ToolError(f"{place}: {paths[-1]}: no such file")
    if not paths:
        raise ToolError(f"{folder / _LIST_NAME}: lists no images")
    return _Images(paths, stamps, _TUM_UNITS_PER_M)


def _found(folder: Path) -> _Images:
    """Return the images as Open3D has them: all that lie in a folder."""
    paths = in_order((folder / _FOLDER_NAME).glob("*.png"))
    if not paths:
        raise ToolError(f"{folder}: holds neither {_LIST_NAME} nor {_FOLDER_NAME}/*.png")
    return _Images(paths, None, _OPEN3D_UNITS_PER_M)
