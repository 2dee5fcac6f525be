"""Telling what kind of recording a path is."""

from pathlib import Path

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.bag import find_bag
from triquad_tools.recordings.recording import Recording
from triquad_tools.recordings.ros_options import RosOptions
from triquad_tools.recordings.ros_recording import RosRecording


def open_recording(path: Path, options: RosOptions) -> Recording:
    """A recording, after all of it was looked through.

    Raises:
        ToolError: there is none, it is damaged, or does not hold what ``options`` ask for.
    """
    if not path.exists():
        raise ToolError(f"{path}: no such file or folder")
    bag = find_bag(path)
    if bag is not None:
        return RosRecording(bag, options)
    raise ToolError(f"{path}: no recording that is understood")
