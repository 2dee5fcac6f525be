"""What cannot be opened as a recording, or written as a map, is told with the remedy."""

import errno
from pathlib import Path

import numpy as np
import pytest
from support.recordings.bags import BagKind, drive, messages_for, write_bag
from support.recordings.point_files import columns, write_ply
from triquad_tools.console.command import ToolError
from triquad_tools.mapping.output import why
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("a.zip", "unzip"),
        ("a.tar.gz", "tar -xf"),
        ("a.pcd.zst", "unzstd"),
        ("A.bag.GZ", "gunzip"),
    ],
)
def test_what_is_packed_is_refused_with_the_command_that_unpacks_it(tmp_path, name, command):
    (tmp_path / name).write_bytes(b"packed")
    with pytest.raises(ToolError, match=f"{name}: is packed: unpack it with '{command} /.*{name}'"):
        open_recording(tmp_path / name, ReadingOptions())


def test_a_full_disk_is_called_that():
    assert why(OSError(errno.ENOSPC, "No space left")).startswith("the disk is full (")
    assert why(PermissionError(errno.EACCES, "denied")) == "[Errno 13] denied"


@pytest.mark.parametrize("kind", ["sqlite3", "ros1"])
def test_a_damaged_bag_is_refused_with_the_remedy(tmp_path: Path, kind: BagKind) -> None:
    scans, poses = [np.ones((30, 3), np.float32)] * 6, np.tile(np.eye(4), (6, 1, 1))
    stamps = [10**18 + i * 10**8 for i in range(6)]
    messages = drive(messages_for(kind), scans, poses, stamps, np.eye(4))
    path = write_bag(tmp_path / "bag", kind, messages)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[:-2000])
    with pytest.raises(ToolError, match="saves what is left") as caught:
        list(open_recording(path, ReadingOptions()).read(range(6)))
    assert "\n" not in str(caught.value)


def test_recordings_deep_in_a_folder_are_named_and_can_be_read(tmp_path: Path) -> None:
    folder = tmp_path / "all" / "day" / "lidar"
    folder.mkdir(parents=True)
    for number in range(3):
        write_ply(folder / f"{number}.ply", columns(5 * np.eye(3, dtype=np.float32)))
    (folder / "poses.txt").write_text("0 0 0 0 0 0 1\n" * 3)
    with pytest.raises(ToolError, match=r"give one of the recordings in it, \S*/all/day$"):
        open_recording(tmp_path, ReadingOptions())
    assert len(open_recording(tmp_path / "all" / "day", ReadingOptions()).entries) == 3
