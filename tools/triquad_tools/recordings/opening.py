"""Finding out what kind of recording a path is."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.bag import find_bag
from triquad_tools.recordings.folders.cloud_folder import (
    CloudOptions,
    is_cloud_folder,
    read_cloud_folder,
)
from triquad_tools.recordings.folders.depth_folder import (
    DepthOptions,
    is_depth_folder,
    read_depth_folder,
)
from triquad_tools.recordings.folders.kitti import is_kitti_folder, read_kitti_folder
from triquad_tools.recordings.recording import Recording
from triquad_tools.recordings.ros_options import RosOptions
from triquad_tools.recordings.ros_recording import RosRecording

_FLAGS = {"transforms": "transform", "deskew": "no-deskew", "depth_stride": "stride"}
"""Names of flags that are not those of the options they set."""


@dataclass(frozen=True)
class RecordingOptions:
    """Options for reading a recording of any kind."""

    ros: RosOptions = RosOptions()
    clouds: CloudOptions = CloudOptions()
    depth: DepthOptions = DepthOptions()


def open_recording(path: Path, options: RecordingOptions) -> Recording:
    """Return a recording, after all of it was checked.

    Raises:
        ToolError: there is none, it is damaged, or does not hold what ``options`` ask for.
    """
    if not path.exists():
        raise ToolError(f"{path}: no such file or folder")
    ros, clouds, depth = options.ros, options.clouds, options.depth
    bag = find_bag(path)
    if bag is not None:
        _refuse(path, "a bag", clouds, replace(depth, stride=1))
        return RosRecording(bag, ros)
    if is_kitti_folder(path):
        _refuse(path, "a folder in the style of KITTI", ros, clouds, depth)
        return read_kitti_folder(path)
    if is_depth_folder(path):
        kind = "a folder of depth images"
        _refuse(path, kind, replace(ros, depth_stride=1), replace(clouds, trajectory=None))
        return read_depth_folder(path, depth)
    if is_cloud_folder(path):
        _refuse(path, "a folder of clouds", ros, replace(depth, trajectory=None))
        return read_cloud_folder(path, clouds)
    raise ToolError(
        f"{path}: no recording that is understood: give a bag of ROS, an MCAP file, or a folder as "
        "docs/tools.md describes them"
    )


def _refuse(path: Path, kind: str, *others: RosOptions | CloudOptions | DepthOptions) -> None:
    """Refuse options that are given, but are not for the kind of recording that was found."""
    given = [
        f"--{_FLAGS.get(field.name, field.name.replace('_', '-'))}"
        for options in others
        for field in fields(options)
        if getattr(options, field.name) != field.default
    ]
    if given:
        raise ToolError(f"{path} is {kind}, for which {given[0]} means nothing: leave it out")
