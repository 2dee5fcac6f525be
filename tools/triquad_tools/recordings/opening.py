"""Finding out what kind of recording a path is."""

from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass(frozen=True)
class _Reader:
    """The reader of one kind of recording."""

    kind: str  # in words, for messages
    options: frozenset[str]  # the choices that mean something for this kind
    is_of_kind: Callable[[Path], bool]  # whether a path that exists holds such a recording
    read: Callable[[Path, ReadingOptions], Recording]


def _read_bag(path: Path, options: ReadingOptions) -> Recording:
    bag = find_bag(path)
    assert bag is not None  # or another reader would have been chosen
    return RosRecording(bag, options)


_READERS = (
    _Reader(
        "a bag",
        frozenset(
            {"topics", "poses", "map_frame", "body_frame", "transforms", "recorder_clock", "stride"}
        ),
        lambda path: find_bag(path) is not None,
        _read_bag,
    ),
    _Reader(
        "a folder of depth images",
        frozenset({"trajectory", "intrinsics", "units_per_metre", "stride"}),
        is_depth_folder,
        read_depth_folder,
    ),
    _Reader(
        "a folder of clouds",
        frozenset({"trajectory", "points_in", "deskew"}),
        is_cloud_folder,
        read_cloud_folder,
    ),
)
"""All readers; the first whose kind a path is reads it."""


def open_recording(path: Path, options: ReadingOptions) -> Recording:
    """Return a recording, after all of it was checked.

    Raises:
        ToolError: there is none, it is damaged, or does not hold what ``options`` ask for.
    """
    if not path.exists():
        raise ToolError(f"{path}: no such file or folder")
    for reader in _READERS:
        if reader.is_of_kind(path):
            _refuse_others(path, reader, options)
            return reader.read(path, options)
    raise ToolError(
        f"{path}: no recording that is understood: give a bag of ROS, an MCAP file, or a folder as "
        "docs/tools.md describes them"
    )


def _refuse_others(path: Path, reader: _Reader, options: ReadingOptions) -> None:
    """Refuse choices that are not for the kind of recording that was found."""
    for name in options.given:
        if name not in reader.options:
            flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
            raise ToolError(
                f"{path} is {reader.kind}, for which {flag} means nothing: leave it out"
            )
