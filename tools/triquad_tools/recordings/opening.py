"""Telling what kind of recording a path is."""

from dataclasses import dataclass
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


@dataclass(frozen=True)
class RecordingOptions:
    """How a recording is read, whichever kind it turns out to be."""

    ros: RosOptions = RosOptions()
    clouds: CloudOptions = CloudOptions()
    depth: DepthOptions = DepthOptions()


def open_recording(path: Path, options: RecordingOptions) -> Recording:
    """A recording, after all of it was looked through.

    Raises:
        ToolError: there is none, it is damaged, or does not hold what ``options`` ask for.
    """
    if not path.exists():
        raise ToolError(f"{path}: no such file or folder")
    bag = find_bag(path)
    if bag is not None:
        return RosRecording(bag, options.ros)
    if is_kitti_folder(path):
        return read_kitti_folder(path)
    if is_depth_folder(path):
        return read_depth_folder(path, options.depth)
    if is_cloud_folder(path):
        return read_cloud_folder(path, options.clouds)
    raise ToolError(
        f"{path}: no recording that is understood: give a bag of ROS, an MCAP file, or a folder as "
        "docs/tools.md describes them"
    )
