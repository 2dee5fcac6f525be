"""Finding out what kind of recording a path is."""

from pathlib import Path

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.bag import find_bag
from triquad_tools.recordings.folders.cloud_folder import is_cloud_folder, read_cloud_folder
from triquad_tools.recordings.folders.depth_folder import is_depth_folder, read_depth_folder
from triquad_tools.recordings.folders.scan_folder import ScanFolder
from triquad_tools.recordings.recording import ReadingOptions
from triquad_tools.recordings.ros_recording import RosRecording

Recording = RosRecording | ScanFolder
"""A recording that was checked as a whole, so that its errors are known."""

_FLAGS = {"transforms": "--transform", "deskew": "--no-deskew"}
"""The flags whose names are not those of the choices that they set."""


_OF_BAGS = {
    "topics", "poses", "map_frame", "body_frame", "transforms", "recorder_clock", "stride",
}  # fmt: skip
_OF_DEPTH = {"trajectory", "intrinsics", "units_per_metre", "stride"}
_OF_CLOUDS = {"trajectory", "points_in", "deskew"}
"""The choices that mean something for each kind of recording."""


def open_recording(path: Path, options: ReadingOptions) -> Recording:
    """Return a recording, after all of it was checked.

    Raises:
        ToolError: there is none, it is damaged, or does not hold what ``options`` ask for.
    """
    if not path.exists():
        raise ToolError(f"{path}: no such file or folder")
    bag = find_bag(path)
    if bag is not None:
        _refuse_others(f"{path} is a bag", _OF_BAGS, options)
        return RosRecording(bag, options)
    if is_depth_folder(path):
        _refuse_others(f"{path} is a folder of depth images", _OF_DEPTH, options)
        return read_depth_folder(path, options)
    if is_cloud_folder(path):
        _refuse_others(f"{path} is a folder of clouds", _OF_CLOUDS, options)
        return read_cloud_folder(path, options)
    raise ToolError(
        f"{path}: no recording that is understood: give a bag of ROS, an MCAP file, or a folder as "
        "docs/tools.md describes them"
    )


def _refuse_others(what: str, meaningful: set[str], options: ReadingOptions) -> None:
    """Refuse choices that are not for the kind of recording that was found."""
    for name in options.given:
        if name not in meaningful:
            flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
            raise ToolError(f"{what}, for which {flag} means nothing: leave it out")
